"""The loss on which object is picked and at which one it is placed, and positions that are read from it."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from openvima.errors import ConfigError
from openvima.policies.build import build_network
from openvima.policies.nn.action_head import BinsHead, ObservationTokens, point_at_objects, pointing_loss
from openvima.policies.nn.actions import PLACE_NEAR_M, ActionTargets, greedy
from openvima.policies.presets import preset
from openvima.policies.processor import Processor
from openvima.training import TrainingConfig
from openvima.training.building import resolve
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
    # Four tokens of another scene: a word, and three objects, one of which has not moved.
    scene_tokens = torch.randn(B, 4, D, generator=generator)
    scene_points = torch.rand(B, 4, 2, generator=generator, dtype=torch.float64) + 1
    scene_points[:, 0] = math.inf
    scene_points[:, 3] = points[:, 0, 2]
    query = torch.zeros(B, T, dtype=torch.int64)
    grasps = torch.where(points.isfinite(), torch.rand(points.shape, generator=generator), points)
    observations = ObservationTokens(
        tokens, points[..., 0].isfinite(), query, steps, points, grasps, scene_tokens, scene_points
    )
    actions = torch.rand(B, T, 12, generator=generator)
    actions[:, 0, 6:8] = points[:, 0, 2].float() + PLACE_NEAR_M / 2  # near an object; the others may not be
    none = torch.full((B, T), -1)
    return pick, place, observations, ActionTargets(actions, none, none, steps)


def test_a_place_is_scored_with_the_picked_object_in_all_scenes_or_at_none():
    kinds = set()
    for seed in range(6):
        generator = torch.Generator().manual_seed(seed)
        pick, place, observations, targets = _inputs(generator)
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
                grasps = observations.grasps_BTQ2[b, t]
                demonstrated = (grasps - targets.actions_BTC[b, t, :2]).norm(dim=-1).argmin()
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
            others = [2, 3, 4, 5, 8, 9, 10, 11]
            assert torch.equal(found[b, t, others], targets.actions_BTC[b, t, others])
            pick_at = points[b, t, picked].float() if picked else targets.actions_BTC[b, t, :2]
            torch.testing.assert_close(found[b, t, :2], pick_at)
        measured = pointing_loss(pick, place, observations, targets)
        torch.testing.assert_close(measured, loss / targets.steps_BT.sum())
        action_loss = (torch.ones(()), {}, targets.actions_BTC)
        head = BinsHead(8, D, torch.nn.Identity())
        head.points = True
        total, metrics, done = head.add_pointing(action_loss, pick, place, observations, targets)
        torch.testing.assert_close(total, 1 + measured)
        assert metrics["loss/pointing"] == measured and torch.equal(done, found)
        measured.backward()
        assert observations.tokens_BTQD.grad[targets.steps_BT].isfinite().all()
    assert kinds == {"none", "scene", "object"}


@pytest.mark.parametrize("name", ["small", "gato-nano", "flamingo-nano"])
def test_policies_without_a_token_for_each_object_refuse_it(name):
    config = TrainingConfig.of(
        {"data": Path("demos"), "out": Path("run"), "preset": name, "model.points": True}
    )
    with pytest.raises(ConfigError, match=r"points is True|points needs a token for each object"):
        resolve(config)


def test_what_is_measured_in_training_is_what_the_policy_does(demonstrations):
    network = build_network(replace(preset("vima-nano"), points=True), seed=0).eval()
    processor = Processor(*network.config.inputs)
    examples, images = examples_of(demonstrations, processor)
    batch = collate_examples(processor, examples)
    with torch.no_grad():
        features = network.encode_images(images)
        prompt = network.encode_prompt(batch.prompts, features)
        cache = network.init_cache(prompt)
        observations, cache = network._observe(prompt, cache, batch.history, features)
        *_, actions = network.head.loss(network.decoder, cache, observations, batch.targets)
    picks = actions[..., None, :2].to(observations.points_BTQ2)
    distances = (picks - observations.points_BTQ2).norm(dim=-1).amin(-1)
    assert distances[batch.targets.steps_BT].max() < 1e-6
