"""The export in LeRobot itself: it opens it, and writes the same frames in the same form.

Runs where `lerobot` can be imported, or where OPENVIMA_LEROBOT_PYTHON names the Python of an environment that
has it.
"""

import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from openvima.data import Demonstration

EPISODES = "meta/episodes/chunk-000/file-000.parquet"
DATA = "data/chunk-000/file-000.parquet"
HISTOGRAM_BINS = 5000  # from which LeRobot estimates quantiles


def lerobot_python() -> str:
    """The Python to run LeRobot with; skips the test where there is none."""
    named = os.environ.get("OPENVIMA_LEROBOT_PYTHON")
    if named is None and importlib.util.find_spec("lerobot") is None:
        pytest.skip("lerobot is not installed, and OPENVIMA_LEROBOT_PYTHON is not set")
    return named or sys.executable


@pytest.fixture
def twin(tmp_path: Path, export: Path) -> Path:
    """A data set by LeRobot of what it has read in the export; `frames.npz` beside it holds that."""
    folder, script = tmp_path / "twin", Path(__file__).with_name("read_with_lerobot.py")
    command = [lerobot_python(), str(script), str(export), str(folder), str(tmp_path / "frames.npz")]
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home")}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-2000:]
    return folder


def test_lerobot_reads_the_demonstrations_and_writes_files_of_the_same_form(
    tmp_path: Path, export: Path, twin: Path, demos: list[Demonstration]
) -> None:
    # One test, as starting LeRobot takes seconds.
    with np.load(tmp_path / "frames.npz") as frames:
        check_frames(frames, demos)
    check_info(export, twin)
    check_tables(export, twin)
    check_statistics(export, twin)


def check_frames(frames: Mapping[str, np.ndarray], demos: list[Demonstration]) -> None:
    steps = [(demo, step) for demo in demos for step in range(demo.num_steps)]
    assert frames["task"].tolist() == [demo.prompt.text for demo, _ in steps]
    for index, (demo, step) in enumerate(steps):
        given = np.concatenate(list(demo.actions[step].to_arrays().values()))
        np.testing.assert_array_equal(frames["action"][index], given)
        np.testing.assert_array_equal(frames["observation.state"][index][:6], demo.joint_paths[step][0])
        for view in ("front", "top"):
            shown = frames[f"observation.images.{view}"][index] * 255
            assert np.abs(shown - demo.rgb[view][step]).max() < 2.5
            for number, image in enumerate(demo.prompt.images.values()):
                shown = frames[f"observation.images.prompt_{number}_{view}"][index] * 255
                assert np.abs(shown - image.rgb[view]).max() < 2.5


def check_info(export: Path, twin: Path) -> None:
    ours, theirs = (json.loads((folder / "meta/info.json").read_text()) for folder in (export, twin))
    for info in (ours, theirs):
        for feature in info["features"].values():
            for name in ("video.codec", "video.pix_fmt"):  # LeRobot itself writes AV1 in yuv420p
                feature.get("info", {}).pop(name, None)
    assert ours == theirs
    assert list(ours["features"]) == list(theirs["features"])


def check_tables(export: Path, twin: Path) -> None:
    for name in (DATA, EPISODES):
        ours, theirs = (pq.read_schema(folder / name) for folder in (export, twin))
        assert {field.name: field.type for field in ours} == {field.name: field.type for field in theirs}
    assert pq.read_schema(export / DATA).names == pq.read_schema(twin / DATA).names
    assert pq.read_table(export / DATA).to_pydict() == pq.read_table(twin / DATA).to_pydict()
    ours, theirs = (pq.read_table(folder / "meta/tasks.parquet").columns for folder in (export, twin))
    assert [column.to_pylist() for column in ours] == [column.to_pylist() for column in theirs]


def check_statistics(export: Path, twin: Path) -> None:
    ours, theirs = (pq.read_table(folder / EPISODES).to_pylist() for folder in (export, twin))
    for one, other in zip(ours, theirs, strict=True):
        for name in one:
            feature, _, kind = name.removeprefix("stats/").rpartition("/")
            if not name.startswith("stats/"):
                assert one[name] == other[name], name
            elif "images" not in name:
                low, high = (np.array(one[f"stats/{feature}/{end}"], float) for end in ("min", "max"))
                bin_width = (high - low) / HISTOGRAM_BINS if kind.startswith("q") else 0
                rounding = 1e-3 if kind == "std" else 1e-6  # its variance is a difference of float32 squares
                difference = np.abs(np.array(one[name], float) - other[name])
                assert (difference <= bin_width + rounding).all(), name
            elif kind != "std":  # lerobot 0.4.4 squares brightness as bytes, which overflow
                difference = np.abs(np.array(one[name]) - other[name])
                assert difference.max() <= 2.5 / 255, name  # the films were off by 2 levels when it read them
