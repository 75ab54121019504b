"""The loss on which object is picked and at which one it is placed, and positions that are read from it."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from openvima.errors import ConfigError
from openvima.policies.build import build_network
from openvima.policies.nn.action_head import ObservationTokens, add_pointing, point_at_objects, pointing_loss
from openvima.policies.nn.actions import PLACE_NEAR_M, ActionTargets, greedy
from openvima.policies.presets import preset
from openvima.policies.processor import Processor
from openvima.training import TrainingConfig
from openvima.training.building import build_learner, resolve
from small_networks import collate_examples, examples_of

B, T, Q, D = 2, 3, 5, 8


def _inputs(
    generator: torch.Generator,
) -> tuple[torch.Tensor, torch.Tensor, ObservationTokens, ActionTargets]:
    (
        pick,
        place,
    ) = torch.randn(2, B, T, D, generator=generator)
    points = torch.rand(B, T, Q, 2, generator=generator, dtype=torch.float64)
    points[:, :, 0] = math.inf  # no object in the top view
    points[1, 1] = math.inf  # nor any in this step
    steps = torch.tensor([[True, True, True], [True, True, False]])
    tokens = torch.randn(B, T, Q, D, generator=generator, requires_grad=True)
    observations = ObservationTokens(
        tokens, points[..., 0].isfinite(), torch.zeros(B, T, dtype=torch.int64), steps, points
    )
    actions = torch.rand(B, T, 12, generator=generator)
    actions[:, 0, 6:8] = points[:, 0, 2].float() + PLACE_NEAR_M / 2  # near an object; the others may not be
    none = torch.full((B, T), -1)
    return pick, place, observations, ActionTargets(actions, none, none, steps)


def test_it_is_the_cross_entropy_of_the_object_nearest_to_the_demonstrated_position():
    pick, place, observations, targets = _inputs(torch.Generator().manual_seed(0))
    loss = pointing_loss(pick, place, observations, targets)
    found = (torch.zeros(()), {}, targets.actions_BTC)
    value = add_pointing(found, 1.0, pick, place, observations, targets)[1]["loss/pointing"]
    total, counted = 0.0, 0
    tokens, points = observations.tokens_BTQD.detach().numpy(), observations.points_BTQ2.numpy()
    for b, t in np.argwhere(targets.steps_BT.numpy()):
        for query, half, part, limit in (
            (pick, slice(0, 4), slice(0, 2), math.inf),
            (place, slice(4, 8), slice(6, 8), PLACE_NEAR_M),
        ):
            exist = np.flatnonzero(np.isfinite(points[b, t, :, 0]))
            distances = np.linalg.norm(points[b, t] - targets.actions_BTC[b, t, part].numpy(), axis=-1)
            if not len(exist) or distances[exist].min() >= limit:
                continue
            scores = tokens[b, t, :, half] @ query[b, t, half].numpy() / 2
            total += np.log(np.exp(scores[exist]).sum()) - scores[distances.argmin()]
            counted += 1
    assert 5 < counted < 10
    assert loss.item() == pytest.approx(total / targets.steps_BT.sum().item(), rel=1e-5)
    assert value.item() == loss.item() and not value.requires_grad
    loss.backward()
    assert observations.tokens_BTQD.grad[targets.steps_BT].isfinite().all()


def _with_scenes(observations: ObservationTokens, generator: torch.Generator) -> ObservationTokens:
    """Four tokens of the prompt: a word, and three objects of a scene, one of which has not moved."""
    tokens = torch.randn(B, 4, D, generator=generator)
    points = torch.rand(B, 4, 2, generator=generator, dtype=torch.float64) + 1
    points[:, 0] = math.inf
    points[:, 3] = observations.points_BTQ2[:, 0, 2]
    return replace(observations, scene_tokens_BLD=tokens, scene_points_BL2=points)


def test_a_place_may_be_that_of_the_picked_object_in_a_scene_of_the_prompt():
    kinds = set()
    for seed in range(6):
        generator = torch.Generator().manual_seed(seed)
        pick, place, observations, targets = _inputs(generator)
        observations = _with_scenes(observations, generator)
        targets.actions_BTC[:, 1, 6:8] = observations.scene_points_BL2[:, 2].float()
        found = point_at_objects(targets.actions_BTC, pick, place, observations, greedy)
        tokens, points = observations.tokens_BTQD.detach(), observations.points_BTQ2
        loss = torch.zeros(())
        for b, t in np.argwhere(targets.steps_BT.numpy()):
            where = torch.cat([points[b, t], observations.scene_points_BL2[b]])
            keys = torch.cat([tokens[b, t], observations.scene_tokens_BLD[b]])[where[:, 0].isfinite(), 4:]
            where, goal = where[where[:, 0].isfinite()], targets.actions_BTC[b, t, 6:8]
            picked, demonstrated = 0, 0  # the first is no object
            if points[b, t, 1:].isfinite().all():
                of_picks = (tokens[b, t, :, :4] @ pick[b, t, :4] / 2)[1:]
                picked = 1 + of_picks.argmax()
                demonstrated = (points[b, t] - targets.actions_BTC[b, t, :2]).norm(dim=-1).argmin()
                loss = loss - of_picks.log_softmax(0)[demonstrated - 1]
            of_places = [
                torch.cat([keys @ (place[b, t] + tokens[b, t, slot])[4:] / 2, torch.zeros(1)])
                for slot in (demonstrated, picked)
            ]
            apart = (where - goal).norm(dim=-1)
            near = apart.min() < PLACE_NEAR_M
            right = torch.cat([near & (apart <= apart.min() + 0.01), ~near[None]])
            loss = loss - of_places[0].softmax(0)[right].sum().log()
            slot = of_places[1].argmax()
            torch.testing.assert_close(found[b, t, 6:8], goal if slot == len(where) else where[slot].float())
            kinds.add("none" if slot == len(where) else "object" if slot < len(where) - 3 else "scene")
        measured = pointing_loss(pick, place, observations, targets)
        torch.testing.assert_close(measured, loss / targets.steps_BT.sum())
    assert kinds == {"none", "scene", "object"}


@pytest.mark.parametrize("name", ["small", "gato-nano", "flamingo-nano"])
def test_policies_without_a_token_for_each_object_refuse_it(name):
    config = TrainingConfig.of(
        {"data": Path("demos"), "out": Path("run"), "preset": name, "optimizer.pointing_loss_weight": 0.5}
    )
    with pytest.raises(ConfigError, match=f"pointing_loss_weight is 0.5, but preset '{name}'"):
        resolve(config)


@pytest.mark.parametrize("name", ["vima-nano", "midas-nano", "nano-bins"])
def test_it_adds_no_weights(name):
    config = TrainingConfig.of(
        {"data": Path("demos"), "out": Path("run"), "preset": name, "optimizer.pointing_loss_weight": 0.5}
    )
    network = build_learner(config, ["put the block"]).network
    assert network.head.pointing_weight == 0.5
    assert network.config.head == preset(name).head


def test_positions_are_those_of_the_objects_that_the_output_points_at():
    pick, _, observations, targets = _inputs(torch.Generator().manual_seed(1))
    moved = point_at_objects(targets.actions_BTC, pick, pick, observations, greedy)
    tokens, points = observations.tokens_BTQD.detach().numpy(), observations.points_BTQ2.numpy()
    near, others = 0, [2, 3, 4, 5, 8, 9, 10, 11]
    assert torch.equal(moved[..., others], targets.actions_BTC[..., others])
    for b, t in np.ndindex(B, T):
        exist, expected = np.isfinite(points[b, t, :, 0]), targets.actions_BTC[b, t].numpy().copy()
        for half, part in ((slice(0, 4), slice(0, 2)), (slice(4, 8), slice(6, 8))):
            scores = np.where(exist, tokens[b, t, :, half] @ pick[b, t, half].numpy(), -np.inf)
            is_near = np.linalg.norm(points[b, t] - expected[part], axis=-1).min() < 0.06
            if exist.any() and (part.start == 0 or is_near):
                expected[part], near = points[b, t, scores.argmax()], near + (part.start > 0)
        np.testing.assert_allclose(moved[b, t].numpy(), expected, rtol=1e-6)
    assert 0 < near < B * T


@pytest.mark.parametrize("at_scenes", [False, True])
def test_what_is_measured_in_training_is_what_the_policy_does(at_scenes, demonstrations):
    config = replace(preset("vima-nano"), points=True, points_at_scenes=at_scenes)
    network = build_network(config, seed=0).eval()
    processor = Processor.of(network.config.inputs)
    examples, images = examples_of(demonstrations, processor)
    batch = collate_examples(processor, examples)
    with torch.no_grad():
        features = network.encode_images(images)
        prompt = network.encode_prompt(batch.prompts, features)
        observations = network.observe(batch.history, features)
        cache = network.init_cache(prompt)
        *_, actions = network.head.loss(network.decoder, cache, observations, batch.targets)
    picks = actions[..., None, :2].to(observations.points_BTQ2)
    distances = (picks - observations.points_BTQ2).norm(dim=-1).amin(-1)
    assert distances[batch.targets.steps_BT].max() < 1e-6
