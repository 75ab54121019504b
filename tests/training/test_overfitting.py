"""Architectures with tokens of objects and of views overfit 16 demonstrations."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies import preset
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.action_head import encode_bins
from openvima.policies.nn.actions import ACTION_PARTS, to_unit_range
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.processor import Processor
from openvima.scene import Action
from openvima.training import TrainingConfig
from openvima.training.behaviour_cloning import BehaviourCloning
from openvima.training.config import AugmentationConfig, LoaderConfig
from openvima.training.learner import PolicyLearner
from openvima.training.parallel import Parallel
from small_networks import (
    narrow,
    narrow_small,
    source_of,
)

pytestmark = pytest.mark.slow

DEMONSTRATIONS = {
    "rotate": 10,
    "visual_manipulation": 4,
    "manipulate_old_neighbor": 2,
}  # the last in two steps
MAX_STEPS = 140
WARMUP_STEPS = 25
DECAY_STEPS = 20
LEARNING_RATE = 1e-3
# The classifiers start near zero. While they learn how often each bin is right, which says nothing about the
# scene, the rest had better stay as it is: outputs that become alike for all scenes are slow to part again.
HEAD_SHARE = 5.0
# Adam moves each weight alike, and a patch sums up 768 or 3072 pixels, most of them the same in all scenes.
PATCH_SHARE = 0.03


@pytest.fixture(scope="module")
def demonstrations() -> list[Demonstration]:
    """Of each task some, 16 in all."""
    runs = []
    for task, count in DEMONSTRATIONS.items():
        env = TabletopEnv(task, level="train", domain="user")
        runs += [rollout_oracle(env, seed) for seed in range(count)]
    assert len(runs) == 16 and max(run.num_steps for run in runs) == 2
    return runs


def stage_of(model: PolicyNetwork, runs: Sequence[Demonstration], folder: Path) -> BehaviourCloning:
    """Training on all demonstrations in each step, and validation on them."""
    processor = Processor(*model.config.inputs)
    source = source_of(runs, processor)
    config = TrainingConfig(
        data=folder,
        out=folder,
        loader=LoaderConfig(batch_size=len(runs)),
        augmentation=AugmentationConfig(false_positive_prob=0.0),
    )
    learner = PolicyLearner(model, processor, config.augmentation)
    return BehaviourCloning(learner, config, source, source, Parallel(0, 1, torch.device("cpu")))


@pytest.mark.parametrize("architecture", ["vima", "midas"])
def test_each_architecture_overfits_16_demonstrations_and_repeats_them(
    architecture, demonstrations, tmp_path
) -> None:
    model = build_network(preset(f"{architecture}-nano"), seed=0)
    stage = stage_of(model, demonstrations, tmp_path)
    model.eval()  # that is, without dropout
    head = list(model.head.parameters())
    patches = [p for name, p in model.named_parameters() if name.endswith("patches.weight")]
    apart = {id(p) for p in head + patches}
    groups = [
        {"params": [p for p in model.parameters() if id(p) not in apart], "rate": LEARNING_RATE},
        {"params": patches, "rate": LEARNING_RATE * PATCH_SHARE},
        {"params": head, "rate": LEARNING_RATE * HEAD_SHARE},
    ]
    optimizer = torch.optim.AdamW(groups, betas=(0.9, 0.99), weight_decay=0.0, fused=True)
    for step in range(MAX_STEPS):
        for group, warmup in zip(optimizer.param_groups, (WARMUP_STEPS, WARMUP_STEPS, 5), strict=True):
            group["lr"] = group["rate"] * min(1.0, (step + 1) / warmup, (MAX_STEPS - step) / DECAY_STEPS)
        optimizer.zero_grad()
        metrics = stage.backward(step)
        if metrics["accuracy"] == 1 and metrics["loss"] < 0.01:  # then no decision is a near tie
            break
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()
    assert stage.validate()["accuracy"] > 0.99
    pairs = decided_and_recorded(NetworkPolicy(model, dtype=torch.float32), demonstrations)
    same = [torch.equal(bins(action), bins(recorded.to_arrays())) for action, recorded in pairs]
    assert sum(same) / sum(run.num_steps for run in demonstrations) > 0.99


def decided_and_recorded(
    policy: NetworkPolicy, runs: Sequence[Demonstration]
) -> Iterator[tuple[dict[str, np.ndarray], Action]]:
    """Yield what a policy does in each step, in one batch, and what is recorded."""
    policy.reset([run.prompt for run in runs])
    for t in range(max(run.num_steps for run in runs)):
        actions = policy.act([run.observation(t) if t < run.num_steps else None for run in runs])
        for action, run in zip(actions, runs, strict=True):
            if action is not None:
                yield action, run.actions[t]


def bins(action: dict) -> "torch.Tensor":
    """The twelve bins of an action."""
    vector = torch.cat([torch.from_numpy(action[part]) for part in ACTION_PARTS])
    return encode_bins(to_unit_range(vector))


def overfit_pointer(sizes, runs: Sequence[Demonstration], folder: Path, max_steps: int, right: str):
    """Take steps without dropout until each action is right; return the network and its metrics."""
    images, decoder = replace(sizes.images, crop_dropout=0.0), replace(sizes.decoder, dropout=0.0)
    model = build_network(replace(sizes, images=images, decoder=decoder), seed=0)
    stage = stage_of(model, runs, folder)
    optimizer = torch.optim.AdamW(stage.parameters, lr=2e-3)
    for step in range(max_steps):
        optimizer.zero_grad()
        metrics = stage.backward(step)
        if metrics["accuracy"] == metrics[right] == 1:
            break
        optimizer.step()
    return model, stage.validate()


def test_the_object_head_overfits_16_demonstrations(demonstrations, tmp_path) -> None:
    _, metrics = overfit_pointer(narrow("nano"), demonstrations, tmp_path, 150, "accuracy")
    for name in ("accuracy", "pick_accuracy", "place_accuracy", "yaw_accuracy"):
        assert metrics[name] > 0.99, name
    assert metrics["offset_error_m"] < 0.02


@pytest.mark.parametrize("task", ["rearrange_then_restore", "twist"])
def test_the_candidate_head_overfits_positions_of_prompt_and_history(task, tmp_path) -> None:
    """Empty positions, which the object head could express only as offsets from visible objects."""
    env = TabletopEnv(task, level="train", domain="user")
    runs = [rollout_oracle(env, seed) for seed in range(6)]
    model, metrics = overfit_pointer(narrow_small(width=64), runs, tmp_path, 120, "yaw_accuracy")
    assert metrics["accuracy"] > 0.99
    for action, recorded in decided_and_recorded(NetworkPolicy(model, dtype=torch.float32), runs):
        # Held at another point, an object moves by some centimetres, and so do free points.
        assert abs(action["pose1_position"] - recorded.to_arrays()["pose1_position"]).max() < 0.1
