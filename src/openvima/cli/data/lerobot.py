"""`openvima data export-lerobot`: demonstrations as a LeRobot data set."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from openvima.cli.terminal import parse_tasks, progress_bar


def export_lerobot(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    *,
    tasks: str = "all",
    fps: int | None = None,
    pixels: Literal["yuv444p", "yuv420p"] = "yuv444p",
    data_file_mb: int = 100,
    video_file_mb: int = 200,
    force: bool = False,
) -> int:
    """Export demonstrations to the LeRobotDataset v3.0 format; docs/lerobot.md says what is in it.

    Example: openvima data export-lerobot demos demos_lerobot --tasks rotate,twist

    Args:
        folder: Folder of demonstrations.
        out: Folder of the export.
        tasks: Names of tasks with commas between them, or "all".
        fps: Frames a second, a power of two, by default 1; a frame is a step, which has no fixed duration of
            its own. Demonstrations of low-level control have 10, their true rate, with a frame a command.
        pixels: yuv444p keeps colours within 2 of 255 levels; yuv420p is what browsers and graphics cards
            play, at half the resolution of colours.
        data_file_mb: Size in MB below which the Parquet files stay.
        video_file_mb: Size in MB below which the videos stay.
        force: Replace the export that is in OUT.

    Returns:
        Exit status.
    """
    from openvima.data.lerobot import LerobotConfig, export_lerobot

    config = LerobotConfig(
        data=folder,
        out=out,
        tasks=parse_tasks(tasks),
        fps=fps,
        pixels=pixels,
        data_file_mb=data_file_mb,
        video_file_mb=video_file_mb,
        force=force,
    )
    with progress_bar("export") as report:
        export_lerobot(config, report)
    print(f'LeRobotDataset("local/{out.name}", root="{out}") opens it in LeRobot.', file=sys.stderr)
    print(out)
    return 0
