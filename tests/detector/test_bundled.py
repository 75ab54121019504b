"""The bundled detector."""

import numpy as np
import pytest

pytest.importorskip("torch")

from openvima.detector import load_extractor
from openvima.env import TabletopEnv
from openvima.perception.iou import match_ids_to_slots
from openvima.perception.objects import GROUND_TRUTH

TASKS = ("visual_manipulation", "rearrange", "same_shape", "sweep_without_exceeding")
EPISODES = 5


@pytest.mark.parametrize(
    "task", [TASKS[0], *(pytest.param(task, marks=pytest.mark.slow) for task in TASKS[1:])]
)
def test_it_finds_the_objects_of_scenes_and_prompts(task: str) -> None:
    extractor = load_extractor()
    level = "L2" if task.startswith("sweep") else "L3"
    env = TabletopEnv(task, level=level, domain="user")
    num_true, num_right, num_found = 0, 0, 0
    for seed in range(EPISODES):
        observation, _ = env.reset(seed=seed)
        pairs = [(extractor.in_observation(observation), GROUND_TRUTH.in_observation(observation))]
        for image in env.prompt.images.values():
            pairs.append((extractor.in_prompt_image(image), GROUND_TRUTH.in_prompt_image(image)))
        for found, true in pairs:
            visible = true.masks.any(axis=0)
            num_true += int(np.count_nonzero(visible))
            num_right += len(match_ids_to_slots(found, true))
            num_found += len(found)
    assert num_right >= 0.95 * num_true
    assert num_found <= 1.5 * num_true  # split objects and false positives
