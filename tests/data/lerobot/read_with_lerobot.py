"""Runs LeRobot itself, in a process of its own: opens an export, and writes the same frames anew.

Usage: python read_with_lerobot.py EXPORT TWIN FRAMES.npz
"""

import sys
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

COUNTERS = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def main(export: Path, twin: Path, frames: Path) -> None:
    """Store what LeRobot reads in EXPORT, and let it write that to TWIN."""
    dataset = LeRobotDataset("local/export", root=export, video_backend="pyav")
    items = [dataset[index] for index in range(len(dataset))]
    keys = list(dataset.features)
    stored = {key: np.stack([item[key].numpy() for item in items]) for key in keys}
    np.savez(frames, task=np.array([item["task"] for item in items]), **stored)

    features = {
        key: {
            name: tuple(value) if name == "shape" else value
            for name, value in feature.items()
            if name != "info"
        }
        for key, feature in dataset.features.items()
        if key not in COUNTERS
    }
    written = LeRobotDataset.create(
        "local/twin", dataset.fps, features, root=twin, robot_type=dataset.meta.robot_type
    )
    for item in items:
        frame = {key: _as_given(item[key].numpy(), features[key]) for key in features}
        written.add_frame({**frame, "task": item["task"]})
        if item["next.done"]:
            written.save_episode(parallel_encoding=False)
    written.finalize()


def _as_given(array: np.ndarray, feature: dict) -> np.ndarray:
    if feature["dtype"] == "video":
        return np.round(np.moveaxis(array, 0, -1) * 255).astype(np.uint8)
    return array.reshape(feature["shape"])


if __name__ == "__main__":
    main(*(Path(word) for word in sys.argv[1:]))
