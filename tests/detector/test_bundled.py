"""The bundled detector."""

import numpy as np
import pytest

from openvima.detector import load_detector, load_extractor
from openvima.env import TabletopEnv
from openvima.perception.boxes import match_ids_to_slots
from openvima.perception.objects import GROUND_TRUTH


@pytest.mark.parametrize(
    ("task", "episodes"),
    [
        ("visual_manipulation", 3),
        pytest.param("rearrange", 5, marks=pytest.mark.slow),
        pytest.param("sweep_without_exceeding", 5, marks=pytest.mark.slow),
    ],
)
def test_it_finds_the_objects_of_scenes_and_prompts(task: str, episodes: int) -> None:
    extractor = load_extractor()
    level = "L2" if task.startswith("sweep") else "L3"
    env = TabletopEnv(task, level=level, domain="user")
    num_true, num_right, num_found = 0, 0, 0
    for seed in range(episodes):
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


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    """Both views of the first moment of four episodes."""
    env = TabletopEnv("rearrange")
    observations = [env.reset(seed=seed)[0] for seed in range(4)]
    return [observation["rgb"][view] for observation in observations for view in ("front", "top")]


def test_detections_of_several_pairs_of_images_are_those_of_each_pair(frames) -> None:
    # To the bit on the processors at hand; another one may take other kernels for other sizes.
    detector = load_detector()
    swapped, expected, together = [], [], detector.detect_batch(frames)
    for k in range(0, len(frames), 2):
        expected += detector.detect_batch(frames[k : k + 2])
        swapped += detector.detect_batch(frames[k : k + 2][::-1])[::-1]
    for found in (swapped, together):
        for one, other in zip(found, expected, strict=True):
            assert len(one)
            np.testing.assert_array_equal(one.boxes, other.boxes)
            np.testing.assert_allclose(one.scores, other.scores, atol=1e-4)
            assert np.count_nonzero(one.masks != other.masks) <= len(one)


def test_an_image_alone_shows_the_same_objects(frames) -> None:
    detector = load_detector()
    for alone, other in zip(
        map(detector.detect, frames[:4], "ftft"), detector.detect_batch(frames[:4]), strict=True
    ):
        np.testing.assert_array_equal(alone.boxes, other.boxes)
        np.testing.assert_allclose(alone.scores, other.scores, atol=1e-4)
