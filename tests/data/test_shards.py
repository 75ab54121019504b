"""Files of demonstrations: what goes in comes out, and half a file is refused."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from openvima.data import Demonstration, Shard, ShardWriter
from openvima.data.encoding import ShardInfo
from openvima.errors import DatasetError

MadeUp = Callable[..., Demonstration]


def write(path: Path, info: ShardInfo, demos: list[Demonstration]) -> Path:
    with ShardWriter(path, info) as writer:
        for demo in demos:
            writer.write(demo)
    return path


def assert_equal(a: Demonstration, b: Demonstration) -> None:
    for field in dataclasses.fields(Demonstration):
        ours, theirs = getattr(a, field.name), getattr(b, field.name)
        if field.name in ("rgb", "segm"):
            for view in ours:
                assert ours[view].shape == theirs[view].shape
                assert ours[view].dtype == theirs[view].dtype
                assert np.array_equal(ours[view], theirs[view])
        elif field.name == "joint_paths":
            assert [path.tolist() for path in ours] == [path.tolist() for path in theirs]
        elif field.name == "prompt":
            assert ours.text == theirs.text
            assert list(ours.images) == list(theirs.images)
        else:
            assert ours == theirs, field.name


@pytest.mark.parametrize(("num_steps", "num_images"), [(0, 1), (1, 0), (4, 3)])
def test_a_demonstration_comes_back_as_it_was_written(
    tmp_path: Path, made_up: MadeUp, info: ShardInfo, num_steps: int, num_images: int
) -> None:
    demo = made_up(num_steps=num_steps, num_images=num_images)
    shard = Shard(write(tmp_path / "a.arrow", info, [demo]))
    assert shard.info == info
    read = shard[0]
    assert_equal(demo, read)
    assert read.content_hash() == demo.content_hash()
    for name, image in demo.prompt.images.items():
        assert read.prompt.images[name].objects == image.objects
        assert read.prompt.images[name].kind == image.kind
        for view in image.rgb:
            assert np.array_equal(read.prompt.images[name].rgb[view], image.rgb[view])
            assert np.array_equal(read.prompt.images[name].segm[view], image.segm[view])


def test_the_content_hash_notices_any_change(made_up: MadeUp) -> None:
    demo = made_up()
    pixels = {view: images.copy() for view, images in demo.rgb.items()}
    pixels["top"][0, 0, 0, 0] ^= 1
    changed = [
        dataclasses.replace(demo, rgb=pixels),
        dataclasses.replace(demo, seed=demo.seed + 1),
        dataclasses.replace(demo, scenes=demo.scenes[::-1]),
        dataclasses.replace(demo, actions=demo.actions[::-1]),
        dataclasses.replace(demo, pick_ids=demo.pick_ids[::-1]),
        dataclasses.replace(demo, joint_paths=demo.joint_paths[::-1]),
    ]
    assert len({demo.content_hash(), *(other.content_hash() for other in changed)}) == 1 + len(changed)


def test_no_prefix_of_a_shard_reads_as_whole(tmp_path: Path, made_up: MadeUp, info: ShardInfo) -> None:
    whole = write(tmp_path / "a.arrow", info, [made_up(1), made_up(2)]).read_bytes()
    part = tmp_path / "part.arrow"
    for length in (0, 5, 8, len(whole) // 2, len(whole) - 100, len(whole) - 6, len(whole) - 1):
        part.write_bytes(whole[:length])
        with pytest.raises(DatasetError, match=r"part\.arrow.*truncated"):
            Shard(part)


def test_a_foreign_or_missing_file_is_named(tmp_path: Path) -> None:
    table = pa.table({"a": [1]})
    with pa.OSFile(str(tmp_path / "f.arrow"), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    with pytest.raises(DatasetError, match="no demonstrations of this package"):
        Shard(tmp_path / "f.arrow")
    with pytest.raises(DatasetError, match=r"no file .*gone\.arrow"):
        Shard(tmp_path / "gone.arrow")
