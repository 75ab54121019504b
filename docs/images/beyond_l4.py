"""Make beyond_l5.png to beyond_l8.png beside this file: an episode of each level, solved."""

from pathlib import Path

import openvima
from openvima.evaluation.recording import save_episode_image

SHOWN = {
    "L5": ("visual_manipulation", 2),
    "L6": ("define_rotate_put_it_restore", 1),
    "L7": ("refer_by_relation", 8),
    "L8": ("sort_by_texture", 1),
}

for level, (task, seed) in SHOWN.items():
    env = openvima.make(task, level=level, domain="eval").unwrapped
    path = Path(__file__).with_name(f"beyond_{level.lower()}.png")
    save_episode_image(env, path, seed=seed, enlarge=1)
