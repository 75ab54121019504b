"""What `openvima data info` says of a folder, in the terminal, for machines and as a page."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from openvima.cli.main import main
from openvima.data import Dataset, Demonstration, GenerateConfig, ShardWriter, generate
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import finish_folder
from openvima.data.page import make_episode_card, write_page
from openvima.data.summary import Histogram, Summary, summarise_folder
from openvima.errors import ConfigError, DatasetError
from openvima.html import render_page
from openvima.scene import Action

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


class Page(HTMLParser):
    """Collects ids and sources, and notices elements that are not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.ids += [values["id"]] if "id" in values else []
        self.links += [values[name] for name in ("src", "href") if name in values]
        if tag not in ("meta", "link", "img", "wbr"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("wbr",):
            assert self.open.pop() == tag


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


def test_an_empty_folder_holds_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="holds no data set"):
        summarise_folder(tmp_path)


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


def test_the_page_needs_nothing_else_and_names_nothing_twice(demos: Path, tmp_path: Path) -> None:
    text = write_page(finished(demos, details=True), tmp_path / "a.html", num_samples=2).read_text("utf-8")
    page = Page(text)
    assert page.open == []
    assert len(set(page.ids)) == len(page.ids)
    assert all(link.startswith(("data:", "#")) for link in page.links)
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    assert "<script" not in text
    assert "http" not in text
    assert text.count("<article") == 6
    dataset = Dataset(demos)
    assert all(dataset[place].content_hash() in text for place in (0, 1, 3, 4, 6, 7))


def test_equal_data_give_equal_pages(demos: Path, tmp_path: Path) -> None:
    summary = finished(demos)
    pages = [write_page(summary, tmp_path / name, num_samples=1).read_bytes() for name in ("a", "b")]
    assert pages[0] == pages[1]
    assert str(demos).encode() not in pages[0]


def drawn_episode(demo: Demonstration) -> str:
    return render_page("episode", card=make_episode_card(demo))


def drawn_chart(histogram: Histogram) -> str:
    return render_page("histogram", chart=histogram)


def test_names_from_files_cannot_change_the_page(made_up: MadeUp) -> None:
    demo = made_up(num_images=0)
    evil = replace(demo.prompt, text="<script>alert(1)</script>")
    card = drawn_episode(replace(demo, prompt=evil, level='"><b>', domain="<i>"))
    assert "<script" not in card
    assert "<b>" not in card
    assert "<i>" not in card
    assert "<b>" not in drawn_chart(Histogram("a", {"<b>": 1}))


def test_captions_say_what_was_done(made_up: MadeUp) -> None:
    demo = replace(made_up(num_steps=1, num_images=0), end_effector="suction")
    there = Action.planar((0.3, 0.1), (0.6, -0.2))
    turned = Action.planar((0.3, 0.1), (0.3, 0.1), -0.5236)
    assert "1: move red swirl flower<" in drawn_episode(replace(demo, actions=(there,)))
    placed = drawn_episode(replace(demo, actions=(there,), place_ids=(6,)))
    assert "1: move red swirl flower to red swirl flower<" in placed
    in_place = drawn_episode(replace(demo, actions=(turned,), place_ids=(5,)))
    assert "1: turn red swirl flower 30° to the right<" in in_place
    assert "<path" not in in_place
    swept = drawn_episode(replace(demo, actions=(there,), end_effector="spatula"))
    assert "1: sweep red swirl flower<" in swept
    unknown = drawn_episode(replace(demo, actions=(there,), pick_ids=(-2,), place_ids=(-2,)))
    assert "1: move an object<" in unknown


def test_arrows_begin_and_end_where_the_action_does(made_up: MadeUp) -> None:
    demo = made_up(num_steps=1, num_images=0)
    card = drawn_episode(replace(demo, actions=(Action.planar((0.5, 0.0), (0.5, 0.25)),)))
    # The top camera looks at (0.5, 0) with column 128 and row 63, 256 columns a metre; its image lies below.
    assert '<circle cx="128.5" cy="193.5"' in card
    assert 'd="M133.0 193.5L191.2 193.5' in card


def test_long_histograms_show_both_ends() -> None:
    chart = drawn_chart(Histogram("values", {str(n): 100 - n for n in range(50)}))
    assert "… 35 more …" in chart
    assert chart.count("<div") == 15


def test_pages_and_samples_that_make_no_sense_are_refused(
    demos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["data", "info", str(demos), "--html", str(tmp_path)]) == 2
    assert "name of an HTML file" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="samples is -1"):
        write_page(finished(demos), tmp_path / "a.html", num_samples=-1)
