"""`experiments/openvima_small/publish.py`: right numbers, whole figures, whole pages, shipped weights."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("matplotlib")

from dataclasses import asdict

import pytest

from ablations import VARIANTS, Recorded, attribute_table, differences_table, read_rows, settings_of, solved
from findings import Findings, find, read_simulator
from openvima.errors import ConfigError, DatasetError
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.statistics import PairCounts, difference_over_seeds, mean_of_rates
from openvima.policies.build import build_network, count_parameters, outline_network
from openvima.policies.checkpoint import save_checkpoint
from openvima.policies.pointer.config import small
from openvima.policies.variants import with_variant
from openvima.training import TrainingConfig
from publish import record, write
from small_networks import narrow_small
from tables import tables
from weights import facts, settings, ship, shipped

EPISODES = 10
TASKS = {"L1": ("rotate", "twist"), "L2": ("rotate",), "L3": ("twist",), "L4": ("same_texture",)}
WEIGHTS = "ab" * 32
WHERE = {"machine": "a machine", "commit": "abc"}


def evaluation(policy: str, solved: int, *, ablation: str = "", late: int = 0) -> Results:
    """The first `solved` of ten episodes of each task end well, `late` of them a step late."""
    outcomes = tuple(
        EpisodeOutcome(seed, seed < solved, 1 + (seed < late), "", "" if seed < solved else "missed")
        for seed in range(EPISODES)
    )
    rows = tuple(Row(policy, task, x, 1, outcomes, ablation) for x, tasks in TASKS.items() for task in tasks)
    return Results(rows, {"episodes": EPISODES}, {}, {policy: {"kind": "run", "sha256": WEIGHTS}})


def training(folder: Path, name: str, solved: int, *, demonstrations: int = 500) -> dict[str, object]:
    """Write an evaluation, and return the record of its training."""
    evaluation("whatever", solved).write(folder / name / "results.json")
    return {
        "name": name,
        "what": f"what is particular to {name}",
        "demonstrations": demonstrations,
        "steps": 100,
        "minutes": 3.0,
        "parameters": 2_000_000,
        "evaluation": f"{name}/results.json",
    }


@pytest.fixture
def scores(tmp_path: Path) -> Path:
    """Scores, controls and the original simulator; the previous weights are other ones."""
    plain, blind = evaluation("mine", 9, late=2), evaluation("mine", 1, ablation="no_prompt")
    swapped = [replace(row, ablation="swapped_attribute") for row in evaluation("mine", 4).rows[-1:]]
    plain.write(tmp_path / "scores" / "default" / "results.json")
    controls = replace(plain, rows=(*plain.rows, *blind.rows, *swapped))
    controls.write(tmp_path / "scores" / "controls" / "results.json")
    previous = replace(evaluation("old", 6), policies={"old": {"sha256": "cd" * 32}})
    previous.write(tmp_path / "scores" / "previous" / "results.json")
    for seed in range(4):
        path = tmp_path / "scores" / "simulator" / "L3" / "rotate" / f"{seed}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"seed": seed, "success": seed > 0, "failure": False, "steps": 2}))
    guesses = {"rows": [{"measure": "guess", "level": "L1", "right": 2, "episodes": EPISODES}]}
    (tmp_path / "scores" / "guess.json").write_text(json.dumps(guesses))
    (tmp_path / "scores" / "ablations").mkdir()
    row = {
        "variant": "no-rotation",
        "what": "no relative rotation",
        "seed": 0,
        "solved": {"L1": {"twist": "1110"}},
    }
    (tmp_path / "scores" / "ablations" / "no-rotation.json").write_text(json.dumps(row))
    (tmp_path / "scores" / "baselines").mkdir()
    record = training(tmp_path / "scores" / "baselines", "vima", 1)
    (tmp_path / "scores" / "baselines" / "vima.json").write_text(json.dumps(record))
    return tmp_path / "scores"


@pytest.fixture
def findings(scores: Path) -> Findings:
    return find(scores, WEIGHTS)


def test_numbers_are_those_of_the_statistics(findings: Findings) -> None:
    content = record(findings)
    mean, interval = mean_of_rates([(9, EPISODES)] * 2)
    level = content["scores"]["default"]["levels"][0]
    assert (level["level"], level["ablation"], level["mean"]) == ("L1", "", mean)
    assert level["interval"] == [round(end, 6) for end in interval]
    assert content["scores"]["simulator"]["tasks"][0]["successes"] == 3
    json.dumps(content)


def lines_of(table: str) -> dict[str, list[str]]:
    rows = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table.splitlines()]
    return {row[0]: row[1:] for row in rows if len(row) > 1}


def test_tables_show_ours_beside_the_published_and_the_previous(findings: Findings) -> None:
    made = tables(findings, {})
    lines = lines_of(made["simulator"])
    assert lines["openvima-small"][4].startswith("75.0 (") and lines["openvima-small"][2] == "–"
    assert lines["MIDAS, published"][2:] == ["97.8", "97.9", "93.4", "59.1"]
    assert lines_of(made["levels"])["openvima-small"][2].startswith("90.0 (")
    settings = lines_of(made["settings"])
    assert settings["procedural assets"][2].startswith("90.0")
    assert settings["previous weights"][0] == "7.3M"
    assert settings["previous weights"][2].startswith("60.0")
    assert "no prompt" in made["controls"] and "swapped" not in made["controls"]
    assert lines_of(made["controls"])["a guess in place of the policy"][0].startswith("20.0 (")
    swapped = lines_of(made["swapped_attribute"])["same\\_texture, L4"]
    assert [cell.split()[0] for cell in swapped] == ["90.0", "40.0", "33.3"]
    assert lines_of(made["failures"])["rotate, L1"][1] == "missed (1)"
    assert lines_of(made["ablations"])["no relative rotation"][1].startswith("75.0 (")
    assert lines_of(made["baselines"])["what is particular to vima"][:3] == ["2.0M", "100", "0.1"]
    assert made["text"] == made["attributes"] == made["original_tasks"] == ""


def test_scores_of_other_weights_are_refused_and_absent_ones_named(scores: Path, capsys) -> None:
    assert set(find(scores, WEIGHTS).scores) == {"simulator", "default", "controls", "previous"}
    assert "detected is absent" in capsys.readouterr().err
    with pytest.raises(ConfigError, match=r"default is of weights abab.*bundled are efef"):
        find(scores, "ef" * 32)
    with pytest.raises(DatasetError, match="holds no evaluation"):
        find(scores / "default", WEIGHTS)
    with pytest.raises(DatasetError, match="has no episode"):
        read_simulator(scores / "default")
    (scores / "guess.json").write_text('{"rows": [{"measure": "guess"}]}')
    with pytest.raises(DatasetError, match=r"guess\.json cannot be read"):
        find(scores, WEIGHTS)
    (scores / "simulator" / "L3" / "rotate" / "2.json").write_text("{}")
    with pytest.raises(DatasetError, match=r"2\.json cannot be read"):
        read_simulator(scores / "simulator")


@pytest.mark.slow
def test_everything_is_written_and_pages_keep_their_words(tmp_path: Path, findings: Findings) -> None:
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text(
        "before\n<!-- small:settings -->\nold\n<!-- /small:settings -->\nafter\n"
        "<!-- small:levels-figure -->\n<!-- /small:levels-figure -->\n"
    )
    images = tmp_path / "docs" / "images"
    for _ in range(2):  # the second time changes nothing
        write(findings, tmp_path / "out", images, [page], WHERE)
        text = page.read_text()
        assert text.startswith("before\n<!-- small:settings -->\n") and "\nafter\n" in text
        assert "old" not in text and text.count("| previous weights |") == 1
        assert "](images/openvima_small_levels.png)" in text
    assert {file.stem.split("_")[-1] for file in images.iterdir()} == {"levels"}
    assert json.loads((tmp_path / "out.json").read_text())["machine"] == "a machine"
    result = (tmp_path / "out.md").read_text()
    assert "commit `abc`" in result and "particular to vima" in result
    write(Findings({}, {"ablations": "| no head | −3.0 |"}), tmp_path / "out", images, [page], WHERE)
    assert page.read_text() == text
    before = (tmp_path / "out.md").read_text()
    write(Findings({}, baselines=findings.baselines), tmp_path / "out", images, [page], WHERE)
    after = (tmp_path / "out.md").read_text()
    assert after == before and "| 90.0" in after.split("<!-- small:baselines -->")[1]
    assert "particular to vima" in after and "| no head | −3.0 |" in after and "no relative" not in after
    assert set(json.loads((tmp_path / "out.json").read_text())["scores"]) == set(findings.scores)
    with pytest.raises(ConfigError, match="has the evaluations controls, previous, simulator, which are abs"):
        write(Findings({"default": findings.scores["default"]}), tmp_path / "out", images, [page], WHERE)


def test_a_run_is_shipped_with_its_record(tmp_path: Path) -> None:
    run, folder = tmp_path / "run", tmp_path / "package"
    save_checkpoint(build_network(narrow_small(), seed=5), run)
    session = {
        "git": {"commit": "f" * 40, "changed": False},
        "data": {"content_hash": "da7a", "counts": {"episodes": 9}},
    }
    times = [(0, 4, 1800.0), (1, 2, 3600.0), (1, 2, 0.0), (1, 6, 900.0)]  # resumed once
    timings = [
        {"stage": stage, "step": step, "seconds_since_start": s, "cpu_seconds_since_start": s / 2}
        for stage, step, s in times
    ]
    for name, lines in (("sessions", [session]), ("timings", timings)):
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (run / f"{name}_log.jsonl").write_text(text + text[:9])  # a kill cut the last line
    with pytest.raises(DatasetError, match=r"lacks metrics\.jsonl"):
        ship(run, folder)
    metrics = [{"name": name, "step": step} for name, step in (("1-pretraining", 4), ("2-cloning", 6))]
    (run / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in metrics))
    policy = (run / "config.yaml").read_text()  # of the checkpoint, as a run folder has its own
    (run / "config.yaml").write_text(
        f"training:\n  pretraining:\n    grating_prob: 0.4\n    eared_prob: 0.0\n{policy}"
    )
    folder.mkdir()
    (folder / "training_data.json").write_text(json.dumps({"manifest": {"content_hash": "other"}}))
    with pytest.raises(ConfigError, match=r"trained on data da7a.*are other"):
        ship(run, folder)
    (folder / "training_data.json").write_text(json.dumps({"manifest": {"content_hash": "da7a"}}))
    assert shipped(folder) is None
    ship(run, folder)
    found = shipped(folder)
    assert found is not None and (found.steps, found.hours) == ((4, 6), 1.25)
    assert (found.commits, found.episodes) == (("f" * 12,), 9)
    assert dict(facts(found))["demonstrations"] == "9, content hash da7a"
    assert settings(folder) == [("pretraining.grating_prob", "0.4")]
    assert (folder / "model.safetensors").stat().st_size < (run / "model.safetensors").stat().st_size
    session["git"]["changed"] = True
    (run / "sessions_log.jsonl").write_text(json.dumps(session))
    with pytest.raises(ConfigError, match="uncommitted changes"):
        ship(run, folder)


def test_every_variant_differs_from_its_baseline_and_all_fit() -> None:
    def resolved(name: str) -> tuple:
        config = TrainingConfig.of({**settings_of(name, "small"), "data": Path(), "out": Path()})
        return with_variant(VARIANTS[name].change(small()), asdict(config.model)), config.identity()

    for name, variant in VARIANTS.items():
        assert count_parameters(outline_network(resolved(name)[0]))["total"].total < 10_000_000
        assert (resolved(name) == resolved(variant.baseline)) == (name == variant.baseline)


def test_solved_episodes_are_in_the_order_of_seeds() -> None:
    outcomes = tuple(EpisodeOutcome(seed, seed == 7, 1) for seed in (6, 7, 8))
    rows = [Row("policy", task, level, 1, outcomes) for task, level in (("twist", "L1"), ("rotate", "L2"))]
    assert solved(Results(tuple(rows), {}, {}, {"policy": {}})) == {
        "L1": {"twist": "010"},
        "L2": {"rotate": "010"},
    }


def test_differences_are_over_the_seeds_of_both(tmp_path: Path) -> None:
    solved_of = {
        ("full", 0): 8,
        ("full", 1): 6,
        ("no-coreference", 0): 5,
        ("no-coreference", 1): 5,
        ("no-rotation", 1): 9,
    }
    for (name, seed), count in solved_of.items():
        outcomes = {"L1": {"twist": f"{'1' * count:0<{EPISODES}}"}}
        row = {"variant": name, "what": name.replace("-", " "), "seed": seed, "solved": outcomes}
        (tmp_path / f"{name}-{seed}.json").write_text(json.dumps(row))
    lines = differences_table(read_rows(tmp_path)).splitlines()
    rows = {line.split(" | ")[0].strip("| "): line for line in lines if line.startswith("| ")}
    assert "70.0" in rows["full"] and "+" not in rows["full"]
    difference, interval = difference_over_seeds([[PairCounts(5, 0, 3, 2)], [PairCounts(5, 0, 1, 4)]])
    assert f"−{-100 * difference:.1f}" in rows["no coreference"]
    assert f"{100 * interval[1]:.1f}" in rows["no coreference"]
    assert "+30.0" in rows["no rotation"]  # of the seed that both have


def test_attributes_are_shown_where_both_were_trained() -> None:
    with_them = {"L3": {"same_shape": "11"}, "L4": {"same_texture": "11", "follow_motion": "10"}}
    without = {"L3": {"same_shape": "10"}, "L4": {"same_texture": "00", "follow_motion": "10"}}
    full = Recorded("full model", "full", {0: with_them})
    assert attribute_table({"full": full}) == ""
    found = {"full": full, "no-attributes": Recorded("no attributes", "full", {0: without})}
    lines = attribute_table(found).splitlines()
    cells = {line.split(" | ")[0].strip("| "): line.split(" | ")[1:] for line in lines if " | " in line}
    assert [cell.split()[0] for cell in cells["with attributes"]] == ["1", "100.0", "50.0", "75.0", "100.0"]
    assert [cell.split()[0] for cell in cells["without"]] == ["1", "0.0", "50.0", "25.0", "50.0"]
