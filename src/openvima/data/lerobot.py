"""Export of demonstrations to a LeRobotDataset v3.0: Parquet, MP4 and JSON that LeRobot opens as its own."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from openvima import __version__
from openvima.atomic_io import atomic_folder, folder_lock, is_lock_file
from openvima.data.lerobot_files import (
    INFO_PATH,
    PIXEL_FORMATS,
    SOURCE_EPISODES_PATH,
    SOURCE_PATH,
    LerobotWriter,
    PixelFormat,
    write_json,
)
from openvima.data.lerobot_frames import FrameLayout, dense_settings, dense_trajectory, frame_layout
from openvima.data.reader import Dataset
from openvima.errors import ConfigError, DatasetError
from openvima.input_files import settle
from openvima.multiprocess import Report
from openvima.scene.action import CONTROL_HZ, END_EFFECTOR, PRIMITIVES
from openvima.video.encoder import import_av

__all__ = ["LerobotConfig", "export_lerobot", "frame_layout"]


@dataclass(frozen=True, slots=True)
class LerobotConfig:
    """What to export, and where to.

    Args:
        data: Folder of demonstrations.
        out: Folder of the export.
        tasks: Keep the episodes of these tasks only; None keeps all.
        pixels: "yuv444p" keeps colours within 2 of 255 levels; "yuv420p" is what browsers and graphics cards
            play, at half the resolution of colours.
        force: Replace the export that is at `out`.

    Raises:
        ConfigError: A value is not allowed, or `out` holds `data`.
    """

    data: Path
    out: Path
    tasks: tuple[str, ...] | None = None
    pixels: PixelFormat = "yuv444p"
    force: bool = False

    def __post_init__(self) -> None:
        settle(self, paths=("data", "out"), names=("tasks",))
        problems = []
        if self.pixels not in PIXEL_FORMATS:
            problems.append(f"pixels is {self.pixels!r}; allowed are {', '.join(PIXEL_FORMATS)}.")
        if self.data.resolve().is_relative_to(self.out.resolve()):
            problems.append(f"{self.out} holds the demonstrations themselves; give another folder.")
        if problems:
            raise ConfigError(" ".join(problems))


def export_lerobot(config: LerobotConfig, report: Report | None = None) -> Path:
    """Export demonstrations to the LeRobotDataset v3.0 format.

    The folder appears whole, or not at all. The same demonstrations, settings and versions of PyAV and
    pyarrow give the same bytes.

    Args:
        config: What and where to.
        report: Called as `report(episodes done, episodes in all, task)`.

    Returns:
        The folder.

    Raises:
        DatasetError: There are no such demonstrations, or the folder has content and `force` is not set.
        DatasetError: A shard is damaged.
        MissingExtraError: PyAV is not installed.
    """
    import_av()  # before the work begins
    dataset = Dataset(config.data, tasks=config.tasks)
    if not len(dataset):
        raise DatasetError(f"{config.data} has no episodes to export.")
    _check_out(config)
    settings = dense_settings(dataset)
    fps = CONTROL_HZ if settings else 1  # a whole number of float32 seconds, by which LeRobot finds frames
    with folder_lock(config.out), atomic_folder(config.out) as folder:
        with LerobotWriter(
            folder,
            find_layout(dataset, END_EFFECTOR if settings else PRIMITIVES),
            fps=fps,
            pixels=config.pixels,
        ) as writer:
            for number, demo in enumerate(dataset, 1):
                writer.write(dense_trajectory(demo, settings[demo.task, demo.level]) if settings else demo)
                if report:
                    report(number, len(dataset), demo.task)
        _write_source(folder, dataset, config, fps)
    return config.out


def find_layout(dataset: Dataset, control: str) -> FrameLayout:
    """Find what the frames of all episodes have in common, without reading images.

    Args:
        dataset: The demonstrations.
        control: "primitives" or "end_effector".

    Raises:
        DatasetError: An episode has no steps, so no frames either.
    """
    num_images, has_joints = 0, True
    for name in dataset.shard_names():
        table = dataset.shard(name).table(["prompt_images", "joint_paths", "steps"])
        if not table["steps"].to_numpy().all():
            raise DatasetError(f"{dataset.path / name} holds an episode without steps; LeRobot takes none.")
        num_images = max(num_images, *_lengths(table["prompt_images"].combine_chunks()))
        has_joints = has_joints and _has_joints(table)
    return frame_layout(control, num_images, has_joints)


def _has_joints(table: pa.Table) -> bool:
    """Whether there are waypoints of the arm for each step."""
    waypoints = _lengths(table["joint_paths"].combine_chunks().flatten())
    return np.count_nonzero(waypoints) == table["steps"].to_numpy().sum()


def _lengths(lists: pa.ListArray) -> np.ndarray:
    return lists.value_lengths().to_numpy()


def _check_out(config: LerobotConfig) -> None:
    out = config.out
    is_taken = not all(map(is_lock_file, out.iterdir())) if out.is_dir() else out.exists()
    if is_taken and not config.force:
        raise DatasetError(f"{out} is there already; give another folder, or --force to replace it.")
    if is_taken and not (out / INFO_PATH).is_file():
        raise DatasetError(f"{out} holds other things than an export, so --force does not replace it.")


def _write_source(folder: Path, dataset: Dataset, config: LerobotConfig, fps: int) -> None:
    """Write where the episodes came from, which the format has no place for."""
    manifest = dataset.manifest
    source = {key: manifest[key] for key in ("command", "config", "content_hash", "licence", "versions")}
    versions = {"openvima": __version__, "av": import_av().__version__, "pyarrow": pa.__version__}
    settings = {"tasks": config.tasks, "fps": fps, "pixels": config.pixels}
    write_json(
        folder / SOURCE_PATH,
        {
            "command": "openvima data export-lerobot",
            "config": settings,
            "versions": versions,
            "source": source,
        },
    )
    index = dataset.index.select(["task", "level", "seed", "content_hash"])
    numbers = pa.array(range(index.num_rows), pa.int64())
    index = index.add_column(0, "episode_index", numbers)
    pq.write_table(index, folder / SOURCE_EPISODES_PATH, compression="snappy")
