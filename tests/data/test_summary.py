"""What `openvima data info` says of a folder, in the terminal and for machines."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from openvima.cli.main import main
from openvima.data import Dataset, Demonstration, GenerateConfig, ShardWriter, generate
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import finish_folder
from openvima.data.summary import Summary, summarise_folder

MadeUp = Callable[..., Demonstration]


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tasks = ("rotate", "sweep_without_exceeding", "rearrange")
    return generate(GenerateConfig(out=tmp_path_factory.mktemp("demos"), tasks=tasks, episodes=3))


def histogram(summary: Summary, title: str) -> dict[str, int]:
    (found,) = [histogram.counts for histogram in summary.histograms if histogram.title == title]
    return found


def finished(folder: Path, *, details: bool = False) -> Summary:
    summary = summarise_folder(folder, details=details)
    assert isinstance(summary, Summary)
    return summary


def test_counts_are_those_of_the_episodes(demos: Path) -> None:
    summary, dataset = finished(demos, details=True), Dataset(demos)
    assert [task.task for task in summary.tasks] == ["rearrange", "rotate", "sweep_without_exceeding"]
    assert [task.episodes for task in summary.tasks] == [3, 3, 3]
    steps = [demo.num_steps for demo in dataset]
    assert histogram(summary, "steps in an episode") == {str(n): steps.count(n) for n in sorted(set(steps))}
    assert histogram(summary, "end effector") == {"spatula": 3, "suction": 6}
    assert histogram(summary, "level") == {"train": 9}
    num_objects = [len(demo.objects) for demo in dataset]
    counts = {str(n): num_objects.count(n) for n in sorted(set(num_objects))}
    assert histogram(summary, "objects on the table") == counts
    num_images = [len(demo.prompt.images) for demo in dataset]
    assert sum(histogram(summary, "images in the prompt").values()) == 9
    assert histogram(summary, "images in the prompt")[str(num_images[0])] == num_images.count(num_images[0])
    textures = [placed.texture for demo in dataset for placed in demo.objects]
    shown = histogram(summary, "objects on the table, by texture")
    assert shown == {texture: textures.count(texture) for texture in shown}
    assert list(shown.values()) == sorted(shown.values(), reverse=True)
    assert sum(shown.values()) == len(textures)


def test_sizes_add_up(demos: Path) -> None:
    summary = finished(demos)
    assert summary.file_bytes == sum(path.stat().st_size for path in demos.iterdir())
    records = sum(task.bytes for task in summary.tasks)
    assert 0.7 * summary.file_bytes < records < summary.file_bytes


def test_objects_are_counted_only_on_demand(demos: Path) -> None:
    titles = [histogram.title for histogram in finished(demos).histograms]
    assert titles == ["level", "steps in an episode", "end effector"]


def test_failed_episodes_and_object_caches_are_counted(
    demos: Path, tmp_path: Path, made_up: MadeUp, info: ShardInfo
) -> None:
    folder = tmp_path / "demos"
    (folder / "failed").mkdir(parents=True)
    (folder / "object_cache" / "objects-v1").mkdir(parents=True)
    (folder / "object_cache" / "objects-v1" / "a.arrow").write_bytes(bytes(1000))
    for path in (folder / "stack-train-00000.arrow", folder / "failed" / "stack-train-00000.arrow"):
        with ShardWriter(path, info) as writer:
            writer.write(made_up(num_steps=0, num_images=0))
    shards = [folder / "stack-train-00000.arrow"]
    finish_folder(folder, shards, command="openvima generate", config={}, versions=info.versions)
    summary = finished(folder)
    assert (summary.num_failed, summary.object_caches) == (1, {"objects-v1": 1000})
    assert finished(demos).num_failed is None


def test_the_terminal_shows_the_whole(
    demos: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    assert main(["data", "info", str(demos), "--details"]) == 0
    shown = capsys.readouterr().out
    assert f"{demos}: 9 episodes" in shown
    assert "written by openvima generate, assets procedural, compat no" in shown
    assert re.search(r"rotate +3 +\d+ +\d+\.\d +\d+ +\d+\.\d% +\d+\n", shown)
    assert re.search(r"spatula  █+ 3 \(33\.3%\)", shown)
    assert "more …" in shown


def test_machines_read_the_manifest_and_the_overview(demos: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "info", str(demos), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    manifest = json.loads((demos / "dataset.json").read_text())
    assert {name: record[name] for name in manifest} == manifest
    assert record["summary"]["finished"] is True
    assert record["summary"]["tasks"]["rotate"]["episodes"] == 3
