"""Demonstrations of users train like generated ones."""

import random
from pathlib import Path

import pytest

from openvima import compose
from openvima.data import VerifyConfig, record_demonstration, verify
from openvima.scene import Action
from openvima.tasks import sample_episode
from openvima.training import TrainingConfig, train


def record_clicks(folder: Path, count: int) -> None:
    """Record scripted clicks near the middle of objects and bases, half of them in composed scenes."""
    rng = random.Random(0)
    for seed in range(count):
        episode = sample_episode("visual_manipulation", seed=seed)
        if seed % 2:
            block = ("block", "red", (0.45, rng.uniform(-0.4, -0.1)))
            bowl = ("bowl", "green", (0.55, rng.uniform(0.1, 0.4)))
            episode = compose([block, bowl], "Put the {a} into the {b}.", goals=[("in", "a", "b")])
        (goal,), scene = episode.problem.goals, episode.problem.scene
        points = [scene[i].pose.position for i in (goal.object_id, goal.relative_to)]
        pick, place = ((x + rng.uniform(-0.005, 0.005), y + rng.uniform(-0.005, 0.005)) for x, y, _ in points)
        record_demonstration(folder, episode, [Action.planar(pick, place)])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::openvima.errors.UnknownWordWarning")  # of words beyond these few
def test_twenty_demonstrations_by_clicks_verify_and_train(settings: dict, tmp_path: Path) -> None:
    demos = tmp_path / "mine"
    record_clicks(demos, 20)
    found = verify(demos, VerifyConfig(replay=None))
    assert found.is_clean and (found.num_episodes, found.num_replayed) == (20, 20)
    settings |= {"data": demos, "augmentation.paraphrase_prob": 0.5, "augmentation.distractor_prob": 0.5}
    run = train(TrainingConfig.of({**settings, "loader.rerendered_prob": 0.5}))
    assert list((run / "checkpoints").glob("*/model.safetensors"))
