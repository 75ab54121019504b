"""Repair: generated data sets are restored, others keep every whole record."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from openvima.cli.main import main
from openvima.data import (
    Dataset,
    Demonstration,
    GenerateConfig,
    Shard,
    ShardWriter,
    VerifyConfig,
    generate,
    oracle_rollouts,
    repair,
    verify,
)
from openvima.data.encoding import ShardInfo
from openvima.data.object_cache import open_object_cache
from openvima.env import TabletopEnv
from openvima.errors import DatasetError, OpenVimaError, ShardError
from openvima.scene import Outcome
from small_data_sets import contents, with_plain_images, write_folder

MadeUp = Callable[..., Demonstration]
Damage = Callable[[Path], object]
TASKS = ("rotate", "sweep_without_exceeding")
FIRST, LAST = "rotate-train-00000.arrow", "sweep_without_exceeding-train-00001.arrow"
STACK = "stack-train-00000.arrow"
NO_REPLAY = VerifyConfig(replay=0)


def _fail_seed_1(env: TabletopEnv, seed: int) -> object:
    trial = _attempt(env, seed)
    if seed != 1 or not isinstance(trial, Demonstration):
        return trial
    return dataclasses.replace(trial, outcome=Outcome(failure=True, reason="it fell"))


_attempt = oracle_rollouts.attempt


@pytest.fixture(autouse=True)
def seed_1_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that there are failed episodes to keep."""
    monkeypatch.setattr(oracle_rollouts, "attempt", _fail_seed_1)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    config = GenerateConfig(out=out, tasks=TASKS, episodes=3, shard_size=2, keep_failed=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(oracle_rollouts, "attempt", _fail_seed_1)
        return generate(config)


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    return shutil.copytree(whole, tmp_path / "demos")


@pytest.fixture
def merged(tmp_path: Path, made_up: MadeUp, info: ShardInfo) -> Path:
    demos = [with_plain_images(made_up(seed, num_steps=1, num_images=1)) for seed in range(6)]
    return write_folder(tmp_path / "merged", info, [demos[:3], demos[3:]], licence="CC-BY-4.0")


def flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


def blank(path: Path, start: int, num_bytes: int) -> None:
    content = bytearray(path.read_bytes())
    content[start : start + num_bytes] = bytes(num_bytes)
    path.write_bytes(content)


def cut(path: Path, num_bytes: int) -> None:
    path.write_bytes(path.read_bytes()[:num_bytes])


def offset(folder: Path, episode: int) -> int:
    return Dataset(folder).index.column("offset")[episode].as_py()


def test_a_whole_data_set_stays_as_it_is(whole: Path) -> None:
    before = contents(whole)
    done = repair(whole, NO_REPLAY)
    assert done.after.is_clean, done.after.problems
    assert (done.regenerated, done.rewritten, done.lost) == ((), (), ())
    assert contents(whole) == before


@pytest.mark.parametrize(
    ("damage", "regenerated"),
    [
        (lambda f: (f / FIRST).unlink(), {FIRST, f"failed/{FIRST}"}),
        (lambda f: flip(f / FIRST, 9000), {FIRST, f"failed/{FIRST}"}),
        (lambda f: cut(f / LAST, 5000), {LAST}),
        (lambda f: (f / LAST).write_bytes(b""), {LAST}),
        (lambda f: (f / "failed" / FIRST).unlink(), {FIRST, f"failed/{FIRST}"}),
        (lambda f: flip(f / "failed" / FIRST, 9000), {FIRST, f"failed/{FIRST}"}),
        (lambda f: shutil.copy(f / FIRST, f / LAST), {LAST}),
        (lambda f: (f / "index.parquet").unlink(), set()),
        (lambda f: cut(f / "index.parquet", 100), set()),
        (lambda f: flip(f / "failed" / "index.parquet", 100), set()),
        (lambda f: flip(f / "dataset.json", 20), set()),
        (lambda f: (f / "dataset.json").unlink(), set()),
        (lambda f: (f / "failed" / "dataset.json").unlink(), set()),
    ],
)
def test_a_generated_data_set_becomes_what_it_was(
    folder: Path, whole: Path, damage: Damage, regenerated: set[str]
) -> None:
    damage(folder)
    assert not verify(folder, NO_REPLAY).is_clean
    done = repair(folder, NO_REPLAY)
    assert done.after.is_clean, done.after.problems
    assert set(done.regenerated) == regenerated
    assert contents(folder) == contents(whole)


def test_everything_at_once_is_repaired(folder: Path, whole: Path) -> None:
    (folder / "dataset.json").write_text(
        (folder / "dataset.json").read_text().replace('"licence": "MIT"', '"licence": "none"')
    )
    (folder / "index.parquet").unlink()
    (folder / LAST).unlink()
    flip(folder / FIRST, 9000)
    done = repair(folder, NO_REPLAY)
    assert done.after.is_clean, done.after.problems
    assert contents(folder) == contents(whole)


def test_a_lost_manifest_and_shard_are_not_guessed(folder: Path) -> None:
    (folder / "dataset.json").unlink()
    for path in folder.glob("*-00001.arrow"):
        path.write_bytes(b"")
    before = contents(folder)
    with pytest.raises(DatasetError, match=r"manifest of .*demos is lost.*Repeat the command"):
        repair(folder, NO_REPLAY)
    assert contents(folder) == before


def test_shards_that_are_not_all_of_some_settings_are_not_taken_for_them(folder: Path) -> None:
    (folder / "dataset.json").unlink()
    demo = Shard(folder / FIRST)[0]
    with ShardWriter(folder / FIRST, Shard(folder / FIRST).info) as writer:
        writer.write(demo)  # one episode instead of two
    before = contents(folder)
    with pytest.raises(DatasetError, match="is lost"):
        repair(folder, NO_REPLAY)
    assert contents(folder) == before


def test_other_versions_generate_nothing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flip(folder / FIRST, 9000)
    before = contents(folder)
    monkeypatch.setattr(
        "openvima.data.verification.repairing.package_versions", lambda: {"numpy": "99", "openvima": "0.1.0"}
    )
    with pytest.raises(
        DatasetError, match=r"numpy [\d.]+ \(installed: 99\)\. Install .* nothing was changed"
    ):
        repair(folder, NO_REPLAY)
    assert contents(folder) == before


def test_other_versions_still_write_a_lost_index_again(
    folder: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "index.parquet").unlink()
    monkeypatch.setattr("openvima.data.verification.repairing.package_versions", lambda: {"numpy": "99"})
    assert repair(folder, NO_REPLAY).after.is_clean
    assert contents(folder) == contents(whole)


def test_a_shard_that_comes_out_otherwise_replaces_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flip(folder / FIRST, 9000)
    before = contents(folder)
    monkeypatch.setattr(oracle_rollouts, "attempt", _attempt)  # so that seed 1 is solved
    with pytest.raises(DatasetError, match=r"generated again, but not with the bytes"):
        repair(folder, NO_REPLAY)
    assert contents(folder) == before


def test_a_shard_that_was_damaged_before_it_was_listed_is_repaired_too(folder: Path, whole: Path) -> None:
    flip(folder / FIRST, offset(folder, 0) + 10_000)
    (folder / "dataset.json").unlink()
    generate(GenerateConfig(out=folder, tasks=TASKS, episodes=3, shard_size=2, keep_failed=True))
    problem, *_ = verify(folder, NO_REPLAY).problems
    assert problem.file == FIRST
    assert repair(folder, NO_REPLAY).after.is_clean
    assert contents(folder) == contents(whole)


def test_a_repair_that_is_stopped_changes_nothing_and_can_be_repeated(folder: Path, whole: Path) -> None:
    flip(folder / FIRST, 9000)
    before = contents(folder)

    def stop(done: int, total: int, note: str) -> None:
        if note == "generating again":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        repair(folder, NO_REPLAY, stop)
    assert contents(folder) == before
    (folder / ".repair.tmp").mkdir()  # as after a kill
    assert repair(folder, NO_REPLAY).after.is_clean
    assert contents(folder) == contents(whole)


def test_failed_episodes_are_repaired_with_the_others(folder: Path) -> None:
    with pytest.raises(DatasetError, match=r"failed belongs to .*demos; repair that"):
        repair(folder / "failed", NO_REPLAY)


def test_of_data_that_cannot_be_made_again_the_whole_records_are_kept(merged: Path) -> None:
    hashes = [demo.content_hash() for demo in Dataset(merged)]
    flip(merged / STACK, offset(merged, 1) + 3000)
    done = repair(merged, NO_REPLAY)
    assert done.after.is_clean, done.after.problems
    assert done.rewritten == (STACK,)
    assert done.lost == (f"stack train seed 1 ({STACK}, record 1)",)
    dataset = Dataset(merged)
    assert [demo.content_hash() for demo in dataset] == [hashes[0], *hashes[2:]]
    assert (dataset.manifest["command"], dataset.manifest["licence"]) == ("openvima data merge", "CC-BY-4.0")


@pytest.mark.parametrize(
    ("damage", "kept"),
    [
        (lambda path, start: cut(path, start), [0, 3, 4, 5]),
        (lambda path, start: flip(path, start + 4), [0, 2, 3, 4, 5]),  # the length of the record's metadata
        (lambda path, start: blank(path, path.stat().st_size - 200, 200), [0, 1, 2, 3, 4, 5]),  # the footer
        (lambda path, start: blank(path, 16, 500), [0, 1, 2, 3, 4, 5]),  # the schema
        (lambda path, start: path.write_bytes(b""), [3, 4, 5]),
        (lambda path, start: path.unlink(), [3, 4, 5]),
    ],
)
@pytest.mark.parametrize("has_index", [True, False])
def test_no_whole_record_is_lost_whatever_else_is(
    merged: Path, damage: Callable[[Path, int], object], kept: list[int], has_index: bool
) -> None:
    hashes = [demo.content_hash() for demo in Dataset(merged)]
    damage(merged / STACK, offset(merged, 1))
    if not has_index:
        (merged / "index.parquet").unlink()
    done = repair(merged, NO_REPLAY)
    assert done.after.is_clean, done.after.problems
    assert [demo.content_hash() for demo in Dataset(merged)] == [hashes[k] for k in kept]
    assert bool(done.lost) == (len(kept) < 6 or not has_index)


@pytest.mark.parametrize("has_index", [True, False])
def test_a_record_of_which_one_pixel_changed_is_not_kept(
    tmp_path: Path, made_up: MadeUp, info: ShardInfo, has_index: bool
) -> None:
    demos = [made_up(seed, num_steps=0, num_images=0) for seed in range(2)]
    noise = {view: 5 + images % 2 for view, images in demos[0].segm.items()}  # the objects of the scene
    demos = [dataclasses.replace(demo, segm=noise) for demo in demos]
    write_folder(tmp_path, info, [demos])
    flip(tmp_path / STACK, offset(tmp_path, 1) + 200_000)  # noise is stored as it is, so this still decodes
    assert not verify(tmp_path, NO_REPLAY).is_clean
    if not has_index:
        (tmp_path / "index.parquet").unlink()
    assert repair(tmp_path, NO_REPLAY).after.is_clean
    assert [demo.content_hash() for demo in Dataset(tmp_path)] == [demos[0].content_hash()]


def test_a_rewrite_that_is_stopped_before_the_index_is_written_loses_nothing(
    merged: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashes = [demo.content_hash() for demo in Dataset(merged)]
    flip(merged / STACK, offset(merged, 0) + 3000)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("openvima.data.verification.repairing.finish_folder", _interrupted)
        repair(merged, NO_REPLAY)
    assert repair(merged, NO_REPLAY).after.is_clean
    assert [demo.content_hash() for demo in Dataset(merged)] == hashes[1:]


def _interrupted(*args: object, **kwargs: object) -> None:
    raise KeyboardInterrupt


def test_a_manifest_of_imported_data_is_written_again_as_far_as_it_can_be_read(merged: Path) -> None:
    before = contents(merged)
    text = (merged / "dataset.json").read_text()
    (merged / "dataset.json").write_text(text.replace('"episodes": 6', '"episodes": 8'))
    assert repair(merged, NO_REPLAY).after.is_clean
    assert contents(merged) == before
    (merged / "dataset.json").write_text("{")
    with pytest.raises(OpenVimaError, match="is lost"):
        repair(merged, NO_REPLAY)


@pytest.mark.parametrize("has_index", [True, False])  # without it, there is nothing to compare them with, too
def test_records_without_anything_that_says_what_they_are_stay_where_they_are(
    merged: Path, has_index: bool
) -> None:
    path = merged / STACK
    blank(path, 16, 500)
    blank(path, path.stat().st_size - 200, 200)
    if not has_index:
        (merged / "index.parquet").unlink()
    before = contents(merged)
    with pytest.raises(ShardError, match=rf"{STACK} has 3 whole records, but its schema and its footer"):
        repair(merged, NO_REPLAY)
    assert contents(merged) == before


@pytest.mark.parametrize("assets", ["procedural", "nowhere"])  # the task is not there, or the assets are not
def test_records_without_images_that_cannot_be_rendered_are_not_deleted(
    tmp_path: Path, made_up: MadeUp, info: ShardInfo, assets: str
) -> None:
    bare = dataclasses.replace(info, images=False, assets=assets)
    demos = [made_up(seed, num_steps=1, num_images=1) for seed in range(2)]
    path = write_folder(tmp_path, bare, [demos]) / STACK
    blank(path, path.stat().st_size - 200, 200)
    (tmp_path / "index.parquet").unlink()
    before = contents(tmp_path)
    with pytest.raises(ShardError, match=rf"{STACK}: without an index, its records cannot be compared"):
        repair(tmp_path, NO_REPLAY)
    assert contents(tmp_path) == before


def test_cache_files_that_differ_from_the_demonstrations_are_found_and_deleted(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    first, second = (path for path in sorted(open_object_cache(Dataset(folder)).folder.glob("rotate-*")))
    num_files = len(list(folder.glob("*.arrow")))
    assert main(["data", "verify", str(folder), "--replay", "0"]) == 0
    assert f"0 replayed, {num_files} cache files compared\n" in capsys.readouterr().out
    flip(first, first.stat().st_size // 2)
    cut(second, 100)
    names = [str(path.relative_to(folder)) for path in (first, second)]
    assert sorted({problem.file for problem in verify(folder, NO_REPLAY).problems}) == names
    done = repair(folder, NO_REPLAY)
    assert done.after.is_clean, done.after.problems
    assert done.deleted == tuple(names)
    open_object_cache(Dataset(folder))
    assert verify(folder, NO_REPLAY).is_clean


def test_the_command_says_what_it_did(folder: Path, capsys: pytest.CaptureFixture) -> None:
    (folder / LAST).unlink()
    words = ["data", "verify", str(folder), "--replay", "0", "--repair"]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert f"before: 1 problem\n  {LAST}: it is missing" in shown
    assert f"generated again\n  {LAST}" in shown
    assert "no problems" in shown
    (folder / LAST).unlink()
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["repaired"]["regenerated"] == [LAST]
