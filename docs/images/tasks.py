"""Make tasks.png beside this file: one solved episode of each task, before and after."""

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from openvima.env import TabletopEnv
from openvima.evaluation import save_episode_picture

EPISODES = (("visual_manipulation", 7), ("rotate", 3), ("sweep_without_exceeding", 12))

with tempfile.TemporaryDirectory() as folder:
    pictures = []
    for task, seed in EPISODES:
        path = Path(folder) / f"{task}.png"
        save_episode_picture(TabletopEnv(task), path, seed=seed)
        pictures.append(np.asarray(Image.open(path)))
Image.fromarray(np.concatenate(pictures)).save(Path(__file__).with_suffix(".png"), optimize=True)
