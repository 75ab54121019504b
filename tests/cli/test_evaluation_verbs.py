"""The verbs `tasks`, `demo`, `evaluate` and `report`."""

import json

import av
import pytest

from openvima.catalog import original
from openvima.cli.main import main
from openvima.evaluation import EvaluationConfig, evaluate
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.verification import verify_results
from openvima.render import gallery


def test_tasks_lists_prompt_tool_levels_and_steps(capsys):
    assert main(["tasks"]) == 0
    shown = capsys.readouterr().out
    assert "sweep_without_exceeding" in shown and "spatula" in shown and "train L1 L2" in shown


def test_tasks_lists_those_of_a_level(capsys):
    assert main(["tasks", "--level", "L4"]) == 0
    assert "4 tasks" in capsys.readouterr().out
    assert main(["tasks", "--level", "L9"]) == 2
    assert "there is no level 'L9'" in capsys.readouterr().err


def test_tasks_describes_the_options_of_a_task(capsys):
    assert main(["tasks", "rotate"]) == 0
    shown = capsys.readouterr().out
    assert "30+60+90" in shown and "Further objects, 0 … 6" in shown
    assert main(["tasks", "rotat"]) == 2
    assert "Did you mean 'rotate'" in capsys.readouterr().err


def test_demo_records_the_oracle(tmp_path, capsys):
    path = tmp_path / "video.mp4"
    assert main(["demo", "rotate", "--seed", "1", "--out", str(path)]) == 0
    assert "solved; 1 step" in capsys.readouterr().out
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.width == 768


def test_demo_records_low_level_control(tmp_path, capsys):
    path = tmp_path / "video.mp4"
    words = ["demo", "rotate", "--control", "end_effector", "--out", str(path)]
    assert main(words) == 0
    steps = int(capsys.readouterr().out.split("solved; ")[1].split()[0])
    with av.open(str(path)) as container:
        frames = sum(1 for _ in container.decode(video=0))
    assert steps > 20 and frames > 3 * steps  # 30 frames a second, commands of 0.1 s, and stills
    path.unlink()
    assert main([*words, "--policy", "random"]) == 2
    assert "control 'primitives'" in capsys.readouterr().err
    assert not path.exists()
    episode = tmp_path / "episode.yaml"
    assert main(["demo", "--episode", str(episode), "--control", "end_effector"]) == 2
    assert "an episode file is played by primitives" in capsys.readouterr().err


def test_evaluate_then_report(tmp_path, capsys):
    words = (
        f"evaluate --policy oracle,random --tasks rotate --levels L1,L2 --episodes 2 --out {tmp_path}".split()
    )
    assert main([*words, "--videos", "0"]) == 0
    table = capsys.readouterr().out
    assert "oracle" in table and "random" in table and "100.0" in table
    assert main([*words, "--videos", "0", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["policy"] + row["level"] for row in rows] == ["oracleL1", "oracleL2", "randomL1", "randomL2"]
    first = (tmp_path / "report.html").read_text()
    assert main(["report", str(tmp_path), "--out", str(tmp_path / "again.html")]) == 0
    assert (tmp_path / "again.html").read_text() == first


@pytest.mark.parametrize("words", [["demo", "rotate", "--policy"], ["serve"]])
def test_a_preset_is_no_policy(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("openvima.serving.serve", lambda policy, **_: pytest.fail("it is served"))
    assert main([*words, "vima-nano"]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "openvima train --preset vima-nano --data" in error and "untrained:vima-nano" in error


def test_jobs_of_an_array_share_an_evaluation(tmp_path, capsys):
    words = ["evaluate", "--policy", "oracle", "--tasks", "rotate", "--levels", "L1,L2", "--episodes", "1"]
    words += ["--out", str(tmp_path / "scores"), "--no-report"]
    assert main([*words, "--list-shards"]) == 0
    assert capsys.readouterr().out == "0\toracle\trotate\tL1\t0\t1\n1\toracle\trotate\tL2\t0\t1\n"
    assert not (tmp_path / "scores").exists()
    assert main([*words, "--shard-range", "1:1"]) == 2
    assert "shard_range is '1:1'; it must be a:b" in capsys.readouterr().err
    assert main([*words, "--shard-range", "1:2"]) == 0
    assert "lacks batches of other ranges" in capsys.readouterr().err
    assert main([*words, "--shard-range", "0:1"]) == 0
    assert "rotate" in capsys.readouterr().out and (tmp_path / "scores" / "results.json").exists()
    assert main([*words, "--shard-range", "0:1"]) == 0
    assert "is finished" in capsys.readouterr().err


def evaluation(solved: int) -> Results:
    """A policy `mine` that solves so many of 20 episodes, beside the oracle."""
    rows = tuple(
        Row(name, "rotate", "L1", 3, tuple(EpisodeOutcome(i, i < number, 1, "", "") for i in range(20)))
        for name, number in (("mine", solved), ("oracle", 20))
    )
    policies = {"mine": {"kind": "run", "sha256": f"{solved:064}"}, "oracle": {"kind": "oracle"}}
    return Results(rows, {"tasks": ["rotate"], "episodes": 20}, {"openvima": "1"}, policies)


@pytest.fixture
def folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, solved in (("first", 5), ("second", 15)):
        evaluation(solved).write(tmp_path / name / "results.json")
    return tmp_path


def test_several_evaluations_make_one_page_and_leave_theirs_alone(folders, capsys):
    assert main(["report", "first", "second/results.json", "--compare", "mine@second,mine@first,oracle"]) == 0
    said = capsys.readouterr().out
    assert "On L1, mine@second is better than mine@first: +50.0 points" in said
    assert "On L1, oracle is better than mine@second" in said
    page = (folders / "report.html").read_text(encoding="utf-8")
    assert "mine@second against mine@first" in page
    assert page.count("openvima evaluate --policy mine=RUN,oracle") == 2
    assert not (folders / "first" / "report.html").exists()


@pytest.mark.parametrize(("name", "sign"), [("table.md", "| policy | L1 |"), ("table.tex", "\\toprule")])
def test_the_ending_of_the_file_decides_what_is_written(folders, name, sign):
    assert main(["report", "first", "--out", f"paper/{name}"]) == 0
    assert sign in (folders / "paper" / name).read_text(encoding="utf-8")


def test_another_file_of_a_confirmed_folder_is_not_called_confirmed(tmp_path):
    evaluate(EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=1, out=tmp_path))
    verify_results(tmp_path)
    text = (tmp_path / "results.json").read_text()
    (tmp_path / "best.json").write_text(text.replace('"steps": 1', '"steps": 2'))
    shown = {}
    for name in ("results.json", "best.json"):
        assert main(["report", str(tmp_path / name), "--out", str(tmp_path / "table.md")]) == 0
        shown[name] = "outcomes are confirmed by replay" in (tmp_path / "table.md").read_text()
    assert shown == {"results.json": True, "best.json": False}


def test_comparisons_are_printed_as_json(folders, capsys):
    assert main(["report", "first", "second", "--json", "--compare", "mine@first,mine@second"]) == 0
    comparison = json.loads(capsys.readouterr().out)[0]
    assert (comparison["a"], comparison["b"]) == ("mine@first", "mine@second")
    assert comparison["overall"]["verdict"] == "b"


def test_learning_curves_of_runs_are_shown(folders):
    (folders / "run").mkdir()
    (folders / "run" / "metrics.jsonl").write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": 1.0}\n')
    assert main(["report", "first", "--runs", "run", "--out", "page.html"]) == 0
    assert '<section id="training">' in (folders / "page.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "at least one folder"),
        (["first", "--out", "page.pdf"], ".md or .tex"),
        (["first", "--compare", "mine"], "two or more policies"),
        (["first", "--compare", "mine,oracel"], "Did you mean 'oracle'?"),
        (["first", "--runs", "first"], "give the folder of a training run"),
        (["third"], "there is no third"),
    ],
)
def test_wrong_input_of_report_is_one_line_and_status_2(folders, words, message, capsys):
    assert main(["report", *words]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error.splitlines()[-1]
    assert not list(folders.glob("**/*.html"))


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "cache"))


def import_small_pack(tmp_path, monkeypatch, *, damaged: bool = False) -> int:
    """Import a checkout in which every file is a body description without content."""
    names = ("kitting/object-template.urdf", "pallet/pallet.urdf")
    hashes = dict.fromkeys(names, "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855")
    monkeypatch.setattr(original, "known_hashes", lambda: hashes)
    folder = tmp_path / "checkout/vima_bench/tasks/assets"
    (folder / "textures").mkdir(parents=True)
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"")
    if damaged:
        (folder / "pallet/pallet.urdf").write_bytes(b"another")
    return main(["assets", "import", str(tmp_path / "checkout")])


@pytest.mark.slow
def test_a_gallery_prints_its_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gallery, "_pictures", lambda *_: ("", []))
    assert main(["assets", "gallery", "--out", str(tmp_path / "gallery")]) == 0
    page = tmp_path / "gallery" / "index.html"
    assert capsys.readouterr().out.strip() == str(page)
    assert "31 objects, 82 textures" in page.read_text(encoding="utf-8")


def test_an_import_says_how_many_files_it_took(tmp_path, monkeypatch, capsys):
    assert main(["assets", "info"]) == 0
    assert "`openvima assets import CHECKOUT`" in capsys.readouterr().out
    assert import_small_pack(tmp_path, monkeypatch) == 0
    assert "2 of 2 files imported" in capsys.readouterr().out
    assert main(["assets", "info"]) == 0
    assert "2 of 2 files imported" in capsys.readouterr().out


def test_an_incomplete_import_lists_what_it_lacks_and_ends_with_1(tmp_path, monkeypatch, capsys):
    assert import_small_pack(tmp_path, monkeypatch, damaged=True) == 1
    printed = capsys.readouterr()
    assert "1 of 2 files imported" in printed.out
    assert "1 not imported" in printed.err and "pallet/pallet.urdf differs" in printed.err
    assert len([path for path in original.imported_folder().rglob("*") if path.is_file()]) == 1


@pytest.mark.parametrize("words", [["demo", "rotate", "--out", "x.mp4"], ["generate", "--out", "demos"]])
def test_original_assets_without_an_import_are_refused_with_the_command(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--assets", "original"]) == 2
    message = capsys.readouterr().err
    assert "not been imported" in message and "`openvima assets import CHECKOUT`" in message
    assert not list(tmp_path.glob("*.mp4")) and not (tmp_path / "demos").exists()
