"""`experiments/openvima_small/results.py`: right numbers, whole figures, pages left alone."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("matplotlib")

from findings import Findings, find, read_trainings
from openvima.errors import ConfigError, DatasetError, UnknownPolicyError
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.statistics import PairCounts, mean_difference, mean_of_rates
from results import fill, record, tables, write

EPISODES = 10
TASKS = {"L1": ("rotate", "twist"), "L2": ("rotate",), "L3": ("twist",), "L4": ("same_texture",)}
WHERE = {"machine": "a machine", "commit": "abc"}


def evaluation(policy: str, solved: int, *, ablation: str = "", late: int = 0) -> Results:
    """The first `solved` of ten episodes of each task end well, `late` of them a step late."""
    outcomes = tuple(
        EpisodeOutcome(seed, seed < solved, 1 + (seed < late), "", "" if seed < solved else "missed")
        for seed in range(EPISODES)
    )
    rows = tuple(Row(policy, task, x, 1, outcomes, ablation) for x, tasks in TASKS.items() for task in tasks)
    return Results(rows, {"episodes": EPISODES}, {}, {policy: {"kind": "run", "sha256": "ab" * 32}})


def training(folder: Path, name: str, solved: int, *, demonstrations: int = 500) -> dict[str, object]:
    """Write an evaluation, and return the record of its training."""
    evaluation("whatever", solved).write(folder / name / "results.json")
    return {
        "name": name,
        "what": f"what is particular to {name}",
        "demonstrations": demonstrations,
        "steps": 100,
        "minutes": 3.0,
        "evaluation": f"{name}/results.json",
    }


@pytest.fixture
def records(tmp_path: Path) -> list[dict[str, object]]:
    return [
        training(tmp_path, "full", 8),
        training(tmp_path, "blind", 3),
        training(tmp_path, "same", 8),
        training(tmp_path, "vima", 1),
        training(tmp_path, "tenth", 4, demonstrations=50),
        training(tmp_path, "vima-tenth", 0, demonstrations=50),
    ]


@pytest.fixture
def shipped() -> Results:
    plain = evaluation("openvima-small", 9, late=2)
    blind = evaluation("openvima-small", 1, ablation="no_prompt")
    return replace(plain, rows=(*plain.rows, *blind.rows))


@pytest.fixture
def findings(tmp_path: Path, records: list, shipped: Results) -> Findings:
    (tmp_path / "list.json").write_text(json.dumps(records[:-1]))
    (tmp_path / "one.json").write_text(json.dumps(records[-1]))
    return find(shipped, read_trainings([tmp_path / "list.json", tmp_path / "one.json"]))


def test_trainings_of_equal_effort_are_compared_and_the_others_make_curves(findings: Findings) -> None:
    assert [training.name for training in findings.variants] == ["blind", "same", "vima"]
    assert [training.name for training in findings.curve(vima=False)] == ["tenth", "full"]
    assert [training.name for training in findings.curve(vima=True)] == ["vima-tenth", "vima"]


def test_numbers_are_those_of_the_statistics(findings: Findings) -> None:
    content = record(findings)
    mean, interval = mean_of_rates([(9, EPISODES)] * 2)
    level = content["levels"][0]
    assert (level["level"], level["ablation"], level["mean"]) == ("L1", "", mean)
    assert level["interval"] == [round(end, 6) for end in interval]
    assert level["within_oracle_steps"] == 0.7
    (blind, same, _) = content["differences"]
    difference, interval = mean_difference([PairCounts(3, 0, 5, 2)] * 2)
    assert blind["levels"][0]["difference"] == round(difference, 6) == -0.5
    assert blind["levels"][0]["interval"] == [round(end, 6) for end in interval]
    assert same["overall"]["verdict"] == "noise"
    json.dumps(content)


def test_tables_show_ours_beside_the_published(findings: Findings) -> None:
    made = tables(findings)
    lines = {line.split(" | ")[0].strip("| "): line for line in made["short"].splitlines()}
    assert "| 90.0 (" in lines["openvima-small"] and "52,000" in lines["openvima-small"]
    assert lines["MIDAS, published"].endswith("97.8 | 97.9 | 93.4 | 59.1 |")
    assert "no prompt" in made["input_ablations"] and "same\\_texture" in made["tasks"]
    assert made["ablations"].count("≈") == 4  # of the one that is the same, at every level
    assert [line.split(" | ")[1] for line in made["scaling"].splitlines()[2:]] == ["50", "500", "50", "500"]


@pytest.mark.slow
def test_everything_is_written_and_pages_keep_their_words(tmp_path: Path, findings: Findings) -> None:
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text(
        "before\n<!-- small:short -->\nold\n<!-- /small:short -->\nafter\n"
        "<!-- small:levels-figure -->\n<!-- /small:levels-figure -->\n"
    )
    images = tmp_path / "docs" / "images"
    for _ in range(2):  # the second time changes nothing
        write(findings, tmp_path / "out", images, [page], WHERE)
        text = page.read_text()
        assert text.startswith("before\n<!-- small:short -->\n") and "\nafter\n" in text
        assert "old" not in text and text.count("MIDAS, published") == 1
        assert "](images/openvima_small_levels.png)" in text
    assert {file.stem.split("_")[-1] for file in images.iterdir()} == {"levels", "scaling", "ablations"}
    assert json.loads((tmp_path / "out.json").read_text())["machine"] == "a machine"
    result = (tmp_path / "out.md").read_text()
    assert "commit `abc`" in result and "preset small" in result
    (tmp_path / "out.md").write_text(result.replace("TODO(numbers): what it shows", "It shows"))
    write(findings, tmp_path / "out", images, [page], WHERE)
    assert "It shows" in (tmp_path / "out.md").read_text()


@pytest.mark.slow
def test_without_trainings_the_levels_remain(tmp_path: Path, shipped: Results) -> None:
    findings = find(shipped, [])
    write(findings, tmp_path / "out", tmp_path, [], WHERE)
    assert (tmp_path / "openvima_small_levels.png").exists()
    assert not (tmp_path / "openvima_small_scaling.png").exists()


def test_wrong_inputs_are_named(tmp_path: Path, records: list, shipped: Results) -> None:
    file = tmp_path / "list.json"
    with pytest.raises(DatasetError, match=r"list\.json"):
        read_trainings([file])
    file.write_text(json.dumps([{"name": "full"}]))
    with pytest.raises(DatasetError, match="evaluation"):
        read_trainings([file])
    file.write_text(json.dumps([*records, records[1]]))
    with pytest.raises(ConfigError, match="blind"):
        read_trainings([file])
    file.write_text(json.dumps(records))
    trainings = read_trainings([file])
    with pytest.raises(UnknownPolicyError, match="openvima-smal"):
        find(shipped, trainings, policy="openvima-smal")
    with pytest.raises(UnknownPolicyError, match="ful"):
        find(shipped, trainings, baseline="ful")


@pytest.mark.parametrize("text", ["<!-- small:short -->", "<!-- small:shrt --><!-- /small:shrt -->"])
def test_marks_that_cannot_be_filled_are_named(text: str) -> None:
    with pytest.raises(ConfigError, match=r"page\.md.*short"):
        fill(text, {"short": "table"}, where="page.md")
