"""Importing the published data set: equal content, equal bytes by any road, and nothing lost or hidden."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from openvima.cli.main import main
from openvima.data import Dataset, published
from openvima.data.published import ImportConfig, PublishedData, import_published
from openvima.data.shard import Shard
from openvima.errors import DatasetError
from published_data import PUBLISHED, MadeEpisode, write_zip
from small_data_sets import contents

Files = dict[str, bytes]


def episodes() -> dict[str, Files]:
    """Five episodes of one task, one of them broken, and two of another."""
    made = {
        f"same_profile/{number:06d}": MadeEpisode(number).files(PUBLISHED) for number in (0, 1, 7, 8, 90_000)
    }
    made["same_profile/000007"]["obs.pkl"] = b""
    return {**made, **{f"rotate/00000{number}": MadeEpisode(number).files(PUBLISHED) for number in (3, 5)}}


@pytest.fixture(scope="module", autouse=True)
def small_shards() -> Iterator[None]:
    """Shards of three episodes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(published, "SHARD_SIZE", 3)
        yield


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_zip(tmp_path_factory.mktemp("source") / "vima.zip", episodes())


def config(source: Path, out: Path, **changes: object) -> ImportConfig:
    return replace(ImportConfig(source, out), **changes)


@pytest.fixture(scope="module")
def imported(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return import_published(config(source, tmp_path_factory.mktemp("imported")))


def test_an_import_holds_what_the_source_holds_and_tells_what_was_broken(
    source: Path, imported: Path
) -> None:
    data = {demo.outcome.reason: demo.content_hash() for demo in PublishedData(source).demonstrations()}
    assert {demo.outcome.reason: demo.content_hash() for demo in Dataset(imported)} == data
    shards = ["rotate-train-00000.arrow", "same_shape-train-00000.arrow", "same_shape-train-00001.arrow"]
    assert sorted(contents(imported)) == ["broken.json", "dataset.json", "index.parquet", *shards]
    assert [len(Shard(imported / name)) for name in shards] == [2, 2, 2]
    manifest = json.loads((imported / "dataset.json").read_text())
    assert manifest["command"] == "openvima data import"
    assert manifest["licence"] == "CC BY 4.0"
    assert manifest["counts"]["episodes"] == 6
    digest = PublishedData(source).source.digest()
    origin = {"digest": digest, "episodes": 7, "broken": 1, "unknown_folders": []}
    assert manifest["config"]["source"] == origin
    assert manifest["versions"]["vima"] == digest
    assert json.loads((imported / "broken.json").read_text()) == [
        {
            "member": "same_profile/000007",
            "reason": "obs.pkl: it is truncated or no pickle of data (Ran out of input).",
        }
    ]


@pytest.mark.slow
def test_the_number_of_workers_does_not_change_a_byte(source: Path, imported: Path, tmp_path: Path) -> None:
    calls: list[tuple[int, int, str]] = []
    import_published(config(source, tmp_path, workers=2), report=lambda *numbers: calls.append(numbers))
    assert contents(tmp_path) == contents(imported)
    assert calls[0] == (0, 7, "")
    assert calls[-1] == (7, 7, "")


def test_an_import_that_was_stopped_goes_on(source: Path, imported: Path, tmp_path: Path) -> None:
    def stop(done: int, total: int, note: str) -> None:
        if done == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_published(config(source, tmp_path), report=stop)
    assert sorted(contents(tmp_path)) == ["rotate-train-00000.arrow", "same_shape-train-00000.arrow"]
    (tmp_path / ".same_shape-train-00001.arrow.1.tmp").touch()  # of a process that was killed
    before = (tmp_path / "rotate-train-00000.arrow").stat().st_mtime_ns
    import_published(config(source, tmp_path))
    assert contents(tmp_path) == contents(imported)
    assert (tmp_path / "rotate-train-00000.arrow").stat().st_mtime_ns == before
    (tmp_path / "same_shape-train-00000.arrow").unlink()
    import_published(config(source, tmp_path))
    assert contents(tmp_path) == contents(imported)


def test_an_import_can_be_extended_but_not_cut(source: Path, imported: Path, tmp_path: Path) -> None:
    import_published(config(source, tmp_path, episodes=1, tasks=("same_profile",)))
    assert [demo.seed for demo in Dataset(tmp_path)] == [0]
    import_published(config(source, tmp_path))
    assert contents(tmp_path) == contents(imported)
    with pytest.raises(DatasetError, match=r"00001\.arrow .* of its 2 episodes 1 are asked for"):
        import_published(config(source, tmp_path, episodes=4))
    assert contents(tmp_path).keys() >= {"dataset.json"}


def test_an_import_of_another_source_needs_force(source: Path, imported: Path, tmp_path: Path) -> None:
    other = write_zip(tmp_path / "other.zip", {"rotate/000001": MadeEpisode().files()})
    out = tmp_path / "out"
    import_published(config(other, out))
    with pytest.raises(DatasetError, match=r"00000\.arrow belongs to another data set, .*: vima is"):
        import_published(config(source, out))
    import_published(config(source, out, force=True))
    assert contents(out) == contents(imported)


def test_the_command_line_imports_and_names_what_was_left_out(
    source: Path, imported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["data", "import", str(source), str(tmp_path / "out"), "--tasks", "same_shape"]) == 0
    shown = capsys.readouterr()
    assert shown.out == f"{tmp_path / 'out'}\n"
    assert "1 left out" in shown.err
    assert "same_profile/000007: obs.pkl: it is truncated or no pickle of data" in shown.err.replace(
        "\n", " "
    )
    assert main(["data", "import", str(tmp_path / "no.zip"), str(tmp_path / "out")]) == 2
    assert "there is no file or folder" in capsys.readouterr().err.replace("\n", " ")
