"""What `openvima data info` says of a folder, in the terminal and for machines."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from openvima.cli.main import main
from openvima.data import Dataset, Demonstration, ShardWriter
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import finish_folder
from openvima.data.summary import summarise_folder
from small_data_sets import TASKS

MadeUp = Callable[..., Demonstration]


def test_counts_are_those_of_the_episodes(whole: Path) -> None:
    summary, dataset = summarise_folder(whole, details=True)["summary"], Dataset(whole)
    assert {task: entry["episodes"] for task, entry in summary["tasks"].items()} == dict.fromkeys(TASKS, 3)
    steps = [demo.num_steps for demo in dataset]
    assert summary["histograms"]["steps in an episode"] == {
        str(n): steps.count(n) for n in sorted(set(steps))
    }
    assert summary["histograms"]["end effector"] == {"spatula": 3, "suction": 3}
    assert summary["histograms"]["level"] == {"train": 6}
    num_objects = [len(demo.objects) for demo in dataset]
    counts = {str(n): num_objects.count(n) for n in sorted(set(num_objects))}
    assert summary["histograms"]["objects on the table"] == counts
    num_images = [len(demo.prompt.images) for demo in dataset]
    assert sum(summary["histograms"]["images in the prompt"].values()) == 6
    assert summary["histograms"]["images in the prompt"][str(num_images[0])] == num_images.count(
        num_images[0]
    )
    textures = [placed.texture for demo in dataset for placed in demo.objects]
    shown = summary["histograms"]["objects on the table, by texture"]
    assert shown == {texture: textures.count(texture) for texture in shown}
    assert list(shown.values()) == sorted(shown.values(), reverse=True)
    assert sum(shown.values()) == len(textures)
    assert summary["file_bytes"] == sum(path.stat().st_size for path in whole.iterdir())
    assert (
        0.7 * summary["file_bytes"]
        < sum(entry["bytes"] for entry in summary["tasks"].values())
        < summary["file_bytes"]
    )
    titles = list(summarise_folder(whole)["summary"]["histograms"])  # objects only on demand
    assert titles == ["level", "steps in an episode", "end effector"]


def test_object_caches_are_counted(tmp_path: Path, made_up: MadeUp, info: ShardInfo) -> None:
    folder = tmp_path / "demos"
    (folder / "object_cache" / "objects-v1").mkdir(parents=True)
    (folder / "object_cache" / "objects-v1" / "a.arrow").write_bytes(bytes(1000))
    with ShardWriter(folder / "stack-train-00000.arrow", info) as writer:
        writer.write(made_up(num_steps=0, num_images=0))
    shards = [folder / "stack-train-00000.arrow"]
    finish_folder(folder, shards, command="openvima generate", config={}, versions=info.versions)
    summary = summarise_folder(folder)["summary"]
    assert summary["object_caches"] == {"objects-v1": 1000}


def test_the_terminal_shows_the_whole(
    whole: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    assert main(["data", "info", str(whole), "--details"]) == 0
    shown = capsys.readouterr().out
    assert f"{whole}: 6 episodes" in shown
    assert "written by openvima generate, assets procedural, compat False" in shown
    assert re.search(r"rotate +3 +\d+ +\d+\.\d +\d+ +\d+\.\d% +\d+\n", shown)
    assert re.search(r"spatula  █+ 3 \(50\.0%\)", shown)


def test_machines_read_the_manifest_and_the_overview(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "info", str(whole), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    manifest = json.loads((whole / "dataset.json").read_text())
    assert {name: record[name] for name in manifest} == manifest
    assert record["summary"]["finished"] is True
    assert record["summary"]["tasks"]["rotate"]["episodes"] == 3
