"""Files of demonstrations, reading of data sets, and their format on disk."""

import dataclasses
import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from naive import interleaved
from openvima.data import Dataset, Demonstration, Shard, ShardWriter
from openvima.data.encoding import ShardInfo, encode
from openvima.data.manifest import INDEX_SCHEMA, finish_folder
from openvima.data.records import pixels, planes
from openvima.data.schema import ARRAYS, COLUMNS, SCHEMA_VERSION
from openvima.errors import DatasetError
from small_data_sets import flip_bit
from task_cases import frozen

MadeUp = Callable[..., Demonstration]


def write(path: Path, info: ShardInfo, demos: Sequence[Demonstration]) -> Shard:
    with ShardWriter(path, info) as writer:
        for demo in demos:
            writer.write(demo)
    return Shard(path)


@pytest.fixture
def demo(made_up: MadeUp) -> Demonstration:
    return made_up(3, num_steps=3)


@pytest.fixture
def shard(tmp_path: Path, made_up: MadeUp, demo: Demonstration, info: ShardInfo) -> Shard:
    """Two episodes, of which the second is `demo`."""
    return write(tmp_path / "a.arrow", info, [made_up(1), demo])


@pytest.mark.parametrize(("num_steps", "num_images"), [(0, 1), (1, 0), (4, 3)])
def test_a_demonstration_comes_back_as_it_was_written(
    tmp_path: Path, made_up: MadeUp, info: ShardInfo, num_steps: int, num_images: int
) -> None:
    demo = made_up(num_steps=num_steps, num_images=num_images)
    shard = write(tmp_path / "a.arrow", info, [demo])
    assert shard.info == info
    read = shard[0]
    assert frozen(read) == frozen(demo)
    assert list(read.prompt.images) == list(demo.prompt.images)
    assert read.content_hash() == demo.content_hash()


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


def test_a_foreign_or_missing_file_is_named(tmp_path: Path) -> None:
    table = pa.table({"a": [1]})
    with pa.OSFile(str(tmp_path / "f.arrow"), "wb") as sink, pa.ipc.new_file(sink, table.schema) as writer:
        writer.write_table(table)
    with pytest.raises(DatasetError, match="no demonstrations; this package reads version 2"):
        Shard(tmp_path / "f.arrow")
    with pytest.raises(DatasetError, match=r"no file .*gone\.arrow"):
        Shard(tmp_path / "gone.arrow")


def test_every_column_is_read_alone(shard: Shard, demo: Demonstration) -> None:
    row = encode(demo).to_pylist()[0]
    for name in COLUMNS.names:
        (value,) = shard.read(1, [name]).values()
        if name in ARRAYS:
            assert value.reshape(len(row[name]), -1).tolist() == row[name], name
        elif name == "joint_paths":
            assert [path.tolist() for path in value] == row[name]
        else:
            assert value == row[name], name


def test_arrays_have_their_shapes(shard: Shard, demo: Demonstration) -> None:
    values = shard.read(1, ["rgb_top", "segm_front", "prompt_rgb_front", "poses", "pose0_rotation"])
    shapes = {name: value.shape for name, value in values.items()}
    assert shapes == {
        "rgb_top": (4, 128, 256, 3),
        "segm_front": (4, 128, 256),
        "prompt_rgb_front": (2, 128, 256, 3),
        "poses": (4, 2, 7),
        "pose0_rotation": (3, 4),
    }
    assert np.array_equal(values["rgb_top"], np.moveaxis(demo.rgb["top"], 1, -1))
    assert values["poses"][2, 1].tolist() == [
        *demo.scenes[2].placements[1].pose.position,
        *demo.scenes[2].placements[1].pose.quaternion,
    ]


def test_columns_not_asked_for_are_not_decompressed(shard: Shard) -> None:
    def most_bytes(columns: list[str]) -> int:
        usual = pa.default_memory_pool()
        pool = pa.proxy_memory_pool(usual)
        pa.set_memory_pool(pool)
        try:
            Shard(shard.path).read(1, columns)
        finally:
            pa.set_memory_pool(usual)
        return pool.max_memory()

    frames = 4 * 128 * 256
    some = 32_768  # compressed bytes on their way, and the smaller columns
    assert most_bytes(["seed", "pose0_position"]) < some
    assert frames <= most_bytes(["segm_top"]) < frames + some
    assert 3 * frames <= most_bytes(["rgb_top", "seed"]) < 3 * frames + some


def test_unknown_columns_are_refused(shard: Shard) -> None:
    with pytest.raises(DatasetError, match=r"no column 'rgb_tip'\. Did you mean 'rgb_top'"):
        shard.read(0, ["rgb_tip"])


def test_a_data_set_reads_columns_by_episode_and_notices_damage_in_any(
    tmp_path: Path, made_up: MadeUp, info: ShardInfo
) -> None:
    demos = [made_up(seed) for seed in range(3)]
    path = write(tmp_path / "stack-train-00000.arrow", info, demos).path
    finish_folder(tmp_path, [path], command="test", config={}, versions={})
    dataset = pickle.loads(pickle.dumps(Dataset(tmp_path)))
    assert [dataset.read(number, ["seed"])["seed"] for number in (2, 0, -2)] == [2, 0, 1]
    with pytest.raises(IndexError, match="episode 3 of 3"):
        dataset.read(3, ["seed"])
    flip_bit(path)
    with pytest.raises(DatasetError, match="checksum"):
        Dataset(tmp_path).read(1, ["seed"])


def test_many_open_shards_need_no_open_files(tmp_path: Path, demo: Demonstration, info: ShardInfo) -> None:
    files = Path("/proc/self/fd")
    if not files.is_dir():
        pytest.skip("this system does not list open files")
    first = write(tmp_path / "a.arrow", info, [demo])
    before = len(list(files.iterdir()))
    opened = [Shard(first.path) for _ in range(20)]
    assert all(shard.read(0, ["seed"])["seed"] == demo.seed for shard in opened)
    assert len(list(files.iterdir())) == before


def test_colours_are_joined_and_parted_pixel_by_pixel() -> None:
    given = np.random.default_rng(0).integers(0, 256, (3, 3, 128, 256), dtype=np.uint8)
    joined = pixels(given)
    assert np.array_equal(joined[:, :5], interleaved(given[:, :, :5]))
    odd = [np.asfortranarray(image) for image in given]
    assert np.array_equal(pixels(odd), joined)
    assert np.array_equal(planes(joined), given)
    assert planes(joined).flags.c_contiguous


PAGE = (Path(__file__).parents[2] / "docs/format.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"^```python\n(import .*?)^```", PAGE, re.DOTALL | re.MULTILINE)
WITHOUT_PACKAGE = "import sys; sys.modules['openvima'] = None\n"


@pytest.fixture
def demos(tmp_path: Path, made_up: MadeUp, info: ShardInfo) -> Demonstration:
    """An episode in the file that the examples read, below `tmp_path`."""
    demo = made_up(7, num_steps=3)
    (tmp_path / "demos").mkdir()
    with ShardWriter(tmp_path / "demos/rotate-train-00000.arrow", info) as writer:
        writer.write(demo)
    return demo


def run(example: str, folder: Path) -> str:
    command = [sys.executable, "-c", WITHOUT_PACKAGE + example]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_an_image_and_actions_are_read_in_ten_lines(tmp_path: Path, demos: Demonstration) -> None:
    assert len(EXAMPLES[0].splitlines()) <= 12
    said = run(EXAMPLES[0], tmp_path)
    assert f"stack {demos.prompt.text}" in said
    assert "4 images" in said
    assert str([list(action.pose1_position) for action in demos.actions]) in said
    picture = (tmp_path / "first.ppm").read_bytes()
    assert picture == b"P6 256 128 255\n" + demos.rgb["top"][0].transpose(1, 2, 0).tobytes()


def test_the_content_hash_follows_from_the_file(tmp_path: Path, demos: Demonstration) -> None:
    assert run(EXAMPLES[1], tmp_path) == "True\n"


def test_the_page_names_every_column_and_the_version() -> None:
    named = set(re.findall(r"`([a-z0-9_]+)`", PAGE))
    assert {*COLUMNS.names, *INDEX_SCHEMA.names} <= named
    assert f"version of this format: {SCHEMA_VERSION} |" in PAGE
