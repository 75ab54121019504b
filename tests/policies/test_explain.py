"""Explanations: distributions, their agreement with the action, and that asking changes nothing."""

import numpy as np
import pytest
import torch

from openvima.env import TabletopEnv
from openvima.errors import PolicyError
from openvima.policies import load_policy
from openvima.policies.inference import NetworkPolicy
from openvima.policies.presets import preset
from openvima.policies.variants import with_variant
from openvima.render import TOP, unproject
from openvima.scene.explanation import Explanation, bin_positions
from small_networks import perturbed

POINTING = {f"{name} that points": name for name in ("vima-nano", "midas-nano")}
NAMES = ("nano", "small", "nano-bins", "vima-nano", "midas-nano", "gato-nano", "gpt-nano", *POINTING)
FAST = ("nano", "small", *POINTING)


def policy_of(name: str, **options) -> NetworkPolicy:
    config = with_variant(preset(POINTING[name]), {"points": True}) if name in POINTING else name
    network = perturbed(config)
    with torch.no_grad():
        for key, parameter in network.named_parameters():
            if "offset" in key:  # as fresh pointers, it places exactly at its candidate
                parameter.zero_()
    return NetworkPolicy(network, **options)


@pytest.fixture(
    scope="module",
    params=[name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in NAMES],
)
def policy(request) -> NetworkPolicy:
    return policy_of(request.param)


def play(policy: NetworkPolicy, demos, *, explain: bool) -> tuple[list, list[Explanation | None]]:
    """Act twice for three episodes, the second of which ends after one step; six entries each."""
    policy.reset([demo.prompt for demo in demos])
    actions, explanations = [], []
    for step in range(2):
        seen = [None if step and row == 1 else demo.observation(0) for row, demo in enumerate(demos)]
        actions += policy.act(seen)
        if explain:
            explanations += policy.explain()
    return actions, explanations


@pytest.fixture(scope="module")
def demos(demonstrations) -> list:
    return [demonstrations[row] for row in (0, 2, 4)]


def test_every_distribution_sums_to_one_and_its_peak_is_the_action_that_asking_keeps(policy, demos) -> None:
    plain, _ = play(policy, demos, explain=False)
    actions, explanations = play(policy, demos, explain=True)
    assert explanations[4] is None
    for unasked, action, explanation in zip(plain, actions, explanations, strict=True):
        assert (unasked is None) == (action is None)
        if action is None:
            continue
        assert all(unasked[key].tobytes() == action[key].tobytes() for key in action)
        assert explanation.action.keys() == action.keys()
        for weights in explanation.attention.values():
            assert len(weights) == len(explanation.prompt) and weights.min() >= 0
            assert weights.sum() == pytest.approx(1)
        for key, values in action.items():
            assert np.array_equal(explanation.action[key], values)
        if explanation.bins:
            check_bins(explanation)
            if explanation.objects:
                check_positions(explanation)
        else:
            check_pointers(explanation)


def check_bins(explanation: Explanation) -> None:
    assert len(explanation.bins) == 12
    for name, probabilities in explanation.bins.items():
        assert probabilities.sum() == pytest.approx(1)
        key, axis = name.split(".")
        taken = explanation.action[key]["xyzw".index(axis)]
        if "position" in key and explanation.objects:
            continue
        if "position" in key:
            decoded = bin_positions(len(probabilities), "xy".index(axis))
        else:
            decoded = 2 * np.arange(len(probabilities)) / len(probabilities) - 1
        assert decoded[probabilities.argmax()] == pytest.approx(taken, abs=1e-6)
    heat_map = explanation.heat_map("pose1")
    assert heat_map.shape == (50, 100) and heat_map.sum() == pytest.approx(1)


def check_positions(explanation: Explanation) -> None:
    """Of a policy over bins that reads positions from objects."""
    for probabilities in (explanation.objects, explanation.places):
        assert sum(each.probability for each in probabilities) == pytest.approx(1)
    picked = max(explanation.objects, key=lambda each: each.probability)
    np.testing.assert_allclose(picked.grasp, explanation.action["pose0_position"], atol=1e-6)
    place = max(explanation.places, key=lambda each: each.probability)
    np.testing.assert_allclose(place.position, explanation.action["pose1_position"], atol=1e-6)
    assert {each.kind for each in explanation.places} >= {"in view", "first step", "grid"}


def check_pointers(explanation: Explanation) -> None:
    def turned(vector, yaw):
        return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ vector

    for probabilities in (explanation.objects, explanation.places):
        assert sum(each.probability for each in probabilities) == pytest.approx(1)
    assert explanation.yaw_probabilities.sum() == pytest.approx(1)
    picked = max(explanation.objects, key=lambda each: each.probability)
    np.testing.assert_allclose(picked.grasp, explanation.action["pose0_position"], atol=1e-6)
    yaw = explanation.yaw_rad[explanation.yaw_probabilities.argmax()]
    _, _, z, w = explanation.action["pose1_rotation"]
    assert np.exp(1j * yaw) == pytest.approx(complex(w, z) ** 2, abs=1e-5)
    place = max(explanation.places, key=lambda each: each.probability)
    offset = explanation.action["pose1_position"] - np.array(place.position)
    held = turned(offset, -yaw)
    # `small` brings the centre of a carried object to the candidate; else the tool goes there.
    centre = unproject(np.array(picked.boxes["top"][:2], float), TOP)
    assert min(np.abs(held).max(), np.abs(held - (picked.grasp - centre)).max()) < 1e-5
    assert {each.kind for each in explanation.places} <= {"in view", "first step", "prompt", "grid"}
    assert all(0 < each.object_id < 255 and each.boxes for each in explanation.objects)


def test_an_explanation_does_not_depend_on_the_batch(policy, demos) -> None:
    _, together = play(policy, demos, explain=True)
    policy.reset([demos[2].prompt])
    policy.act([demos[2].observation(0)])
    (alone,) = policy.explain()
    for kind, weights in alone.attention.items():
        np.testing.assert_allclose(weights, together[2].attention[kind], atol=1e-9)
    for one, other in zip(alone.places, together[2].places, strict=True):
        assert one.probability == pytest.approx(other.probability, abs=1e-9)


def test_sampled_choices_are_explained_as_they_were_drawn(demos) -> None:
    policy = policy_of("nano", temperature=100.0, generator=torch.Generator().manual_seed(0))
    actions, explanations = play(policy, demos, explain=True)
    for action, explanation in zip(actions[:3], explanations[:3], strict=True):
        grasps = [each.grasp for each in explanation.objects]
        assert any(np.allclose(grasp, action["pose0_position"], atol=1e-6) for grasp in grasps)
        probabilities = [each.probability for each in explanation.objects]
        assert max(probabilities) - min(probabilities) < 0.2  # as hot as that nothing is preferred


def explain_bundled(name: str) -> tuple[Explanation, int]:
    """What a bundled policy considers in an episode, and the id of the object that it should pick."""
    policy, env = load_policy(name), TabletopEnv("visual_manipulation", level="L1")
    observation, _ = env.reset(seed=0)
    policy.reset([env.prompt])
    policy.act([observation])
    (explanation,) = policy.explain()
    return explanation, env.episode.problem.goals[0].object_id


def test_bundled_vima_picks_what_the_prompt_shows_and_places_it_at_an_object_in_view() -> None:
    explanation, goal_id = explain_bundled("openvima-vima")
    picked = max(explanation.objects, key=lambda each: each.probability)
    assert picked.object_id == goal_id
    assert explanation.distinct_places()[0].kind == "in view"


def test_the_bundled_policy_attends_to_what_it_picks_and_to_where_it_goes() -> None:
    explanation, goal_id = explain_bundled("openvima-small")
    peaks = {kind: explanation.prompt[weights.argmax()] for kind, weights in explanation.attention.items()}
    assert peaks == {"pick": "{dragged_obj_1}", "place": "{base_obj}"}
    picked = max(explanation.objects, key=lambda each: each.probability)
    assert picked.object_id == goal_id


def test_what_cannot_be_explained_is_refused(demos) -> None:
    policy = policy_of("nano")
    with pytest.raises(PolicyError, match="act first"):
        policy.explain()
    session = policy.new_session()
    session.reset([demos[0].prompt])
    session.act([demos[0].observation(0)])
    with pytest.raises(PolicyError, match="Sessions of a server"):
        session.explain()
    mixture = NetworkPolicy(perturbed(with_variant(preset("vima-nano"), {"head": "mixture"})))
    with pytest.raises(PolicyError, match=r"Vima has no explain.*openvima-small.*mixture"):
        mixture.explain()
