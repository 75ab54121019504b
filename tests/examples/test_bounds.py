"""`benchmarks/bounds.py`: nearest objects of known similarity, and a network that knows nothing."""

import pytest
import torch

from bounds import ForcedPolicy, nearest, separated
from openvima.env import TabletopEnv
from openvima.evaluation.rollout import play
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.scene import Placement, Pose
from small_networks import narrow_small


def placed(object_id: int, shape: str, texture: str) -> Placement:
    return Placement(object_id, shape, texture, (0.1, 0.1, 0.1), Pose.planar(0.5, 0.0), fixed=shape == "bowl")


OBJECTS = (
    placed(1, "bowl", "red"),
    placed(2, "heart", "red"),
    placed(3, "heart", "blue"),
    placed(4, "star", "red"),
)


def test_the_nearest_object_is_right_if_it_is_what_the_image_shows() -> None:
    shown = [
        placed(0, "heart", "blue"),
        placed(0, "heart", "gray"),
        placed(0, "star", "red"),
        placed(0, "ring", "red"),
    ]
    similarity = torch.tensor([[0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0.5], [1, 0, 0, 0]])
    answers = nearest(shown, OBJECTS, similarity)
    assert [is_right for is_right, *_ in answers] == [True, True, False]  # no ring lies on the table
    assert answers[-1][1:] == ("red star", "red bowl")


@pytest.mark.parametrize(
    ("similarity", "is_separated"), [((1, 0.8, 0.7, 0.9), True), ((1, 0.6, 0.7, 0.9), False)]
)
def test_objects_are_separated_if_the_least_right_one_is_above_all_wrong_ones(
    similarity: tuple[float, ...], is_separated: bool
) -> None:
    answers = separated(OBJECTS[0], {2, 4}, OBJECTS, torch.tensor(similarity), "texture")
    assert answers == [(is_separated, "red: red", "blue")]


@pytest.mark.parametrize(("force", "solved"), [("picks+places", True), ("free", False)])
def test_a_network_that_knows_nothing_solves_what_it_is_forced_to(force: str, solved: bool) -> None:
    policy = NetworkPolicy(build_network(narrow_small(), seed=0), dtype=torch.float32)
    envs = [TabletopEnv("visual_manipulation", level="L1", domain="eval") for _ in range(2)]
    outcomes = play(envs, [0, 1], ForcedPolicy(policy, force, torch.Generator()))
    assert [outcome.success for outcome in outcomes] == [solved, solved]


def test_guesses_follow_from_their_generator_alone_and_are_sometimes_right() -> None:
    def solved(network_seed: int) -> list[bool]:
        policy = NetworkPolicy(build_network(narrow_small(), seed=network_seed), dtype=torch.float32)
        envs = [TabletopEnv("visual_manipulation", level="L1", domain="eval") for _ in range(8)]
        generator = torch.Generator().manual_seed(0)
        return [each.success for each in play(envs, range(8), ForcedPolicy(policy, "guess", generator))]

    assert solved(0) == solved(1)
    assert set(solved(0)) == {True, False}
