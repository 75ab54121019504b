"""Architectures with tokens of objects and of views overfit 32 demonstrations."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies import preset
from openvima.policies.batch import Batch
from openvima.policies.build import build_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.action_head import encode_bins
from openvima.policies.nn.actions import ACTION_PARTS, to_unit_range
from openvima.policies.nn.image_encoders import ConvConfig
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.processor import Processor
from openvima.scene import Action
from openvima.training import TrainingConfig
from openvima.training.behaviour_cloning import BehaviourCloning
from openvima.training.config import AugmentationConfig, LoaderConfig
from openvima.training.learner import PolicyLearner
from openvima.training.parallel import Parallel
from small_networks import (
    collate_examples,
    examples_of,
    narrow_small,
    source_of,
)

pytestmark = pytest.mark.slow

DEMONSTRATIONS = {
    "rotate": 22,
    "visual_manipulation": 6,
    "manipulate_old_neighbor": 4,
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
def demonstrations() -> dict[str, list[Demonstration]]:
    """Of each task some, 32 in all."""
    runs = {}
    for task, count in DEMONSTRATIONS.items():
        env = TabletopEnv(task, level="train", domain="user")
        runs[task] = [rollout_oracle(env, seed) for seed in range(count)]
    assert sum(len(group) for group in runs.values()) == 32
    assert max(run.num_steps for group in runs.values() for run in group) == 2
    return runs


@pytest.mark.parametrize("architecture", ["vima", "midas"])
def test_each_architecture_overfits_32_demonstrations_and_repeats_them(architecture, demonstrations) -> None:
    model = build_network(preset(f"{architecture}-nano"), seed=0).eval()  # that is, without dropout
    tasks = [read(model, group) for group in demonstrations.values()]
    overfit(model, tasks)
    with torch.no_grad():
        _, accuracy = loss_and_accuracy(model, tasks, backward=False)
    assert accuracy > 0.99
    runs = [run for group in demonstrations.values() for run in group]
    assert share_of_recorded_actions(NetworkPolicy(model, dtype=torch.float32), runs) > 0.99


def read(model: PolicyNetwork, runs: Sequence[Demonstration]) -> tuple[Batch, "torch.Tensor"]:
    """One batch of all, and its images."""
    processor = Processor.of(model.config.inputs)
    examples, images = examples_of(runs, processor)
    return collate_examples(processor, examples), images


def overfit(model: PolicyNetwork, tasks: Sequence[tuple[Batch, "torch.Tensor"]]) -> None:
    """Take steps on all demonstrations at once, until each action is right."""
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
        loss, accuracy = loss_and_accuracy(model, tasks, backward=True)
        if accuracy == 1 and loss < 0.03:  # then all bins are right, too
            return
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimizer.step()


def loss_and_accuracy(
    model: PolicyNetwork, tasks: Sequence[tuple[Batch, "torch.Tensor"]], *, backward: bool
) -> tuple[float, float]:
    """Mean loss, and fraction of accurate actions."""
    total = sum(int(batch.targets.steps_BT.sum()) for batch, _ in tasks)
    sums = [0.0, 0.0]
    for batch, images in tasks:
        share = int(batch.targets.steps_BT.sum()) / total
        features = model.encode_images(images)
        prompt = model.encode_prompt(batch.prompts, features)
        loss, metrics = model.loss(prompt, batch.history, features, batch.targets)
        if backward:
            (loss * share).backward()
        for place, value in enumerate((loss, metrics["accuracy"])):
            sums[place] += value.item() * share
    return sums[0], sums[1]


def share_of_recorded_actions(policy: NetworkPolicy, runs: Sequence[Demonstration]) -> float:
    """Return how often a policy repeats the recorded actions, in one batch."""
    pairs = decided_and_recorded(policy, runs)
    same = [torch.equal(bins(action), bins(recorded.to_arrays())) for action, recorded in pairs]
    return sum(same) / sum(run.num_steps for run in runs)


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


def test_the_object_head_overfits_32_demonstrations(demonstrations, tmp_path) -> None:
    sizes = preset("nano")
    sizes = replace(
        sizes,
        images=replace(sizes.images, crop=ConvConfig(8, 32), width=64, crop_dropout=0.0),
        prompt=replace(sizes.prompt, text=replace(sizes.prompt.text, num_layers=1)),
        decoder=replace(sizes.decoder, width=64, num_layers=1, dropout=0.0),
    )
    runs = [run for group in demonstrations.values() for run in group]
    processor = Processor.of(sizes.inputs)
    source = source_of(runs, processor)
    model = build_network(sizes, seed=0)
    learner = PolicyLearner(model, processor)
    config = TrainingConfig(
        data=tmp_path,
        out=tmp_path,
        loader=LoaderConfig(batch_size=32),
        augmentation=AugmentationConfig(false_positive_prob=0.0),
    )
    stage = BehaviourCloning(learner, learner, config, source, source, Parallel(0, 1, torch.device("cpu")))
    optimizer = torch.optim.AdamW(stage.parameters, lr=2e-3)
    for step in range(150):
        optimizer.zero_grad()
        if stage.backward(step)["accuracy"] == 1:
            break
        optimizer.step()
    metrics = stage.validate()
    assert metrics["accuracy"] > 0.99
    assert metrics["pick_accuracy"] > 0.99
    assert metrics["place_accuracy"] > 0.99
    assert metrics["yaw_accuracy"] > 0.99
    assert metrics["offset_error_m"] < 0.02


@pytest.mark.parametrize("task", ["rearrange_then_restore", "twist"])
def test_the_candidate_head_overfits_positions_of_prompt_and_history(task, tmp_path) -> None:
    """Empty positions, which the object head could express only as offsets from visible objects."""
    env = TabletopEnv(task, level="train", domain="user")
    runs = [rollout_oracle(env, seed) for seed in range(6)]
    sizes = narrow_small(width=64)
    images, decoder = replace(sizes.images, crop_dropout=0.0), replace(sizes.decoder, dropout=0.0)
    sizes = replace(sizes, images=images, decoder=decoder)
    processor = Processor.of(sizes.inputs)
    source, model = source_of(runs, processor), build_network(sizes, seed=0)
    learner = PolicyLearner(model, processor)
    config = TrainingConfig(
        data=tmp_path,
        out=tmp_path,
        loader=LoaderConfig(batch_size=6),
        augmentation=AugmentationConfig(false_positive_prob=0.0),
    )
    stage = BehaviourCloning(learner, learner, config, source, source, Parallel(0, 1, torch.device("cpu")))
    optimizer = torch.optim.AdamW(stage.parameters, lr=2e-3)
    for step in range(120):
        optimizer.zero_grad()
        metrics = stage.backward(step)
        if metrics["accuracy"] == metrics["yaw_accuracy"] == 1:
            break
        optimizer.step()
    assert stage.validate()["accuracy"] > 0.99
    policy = NetworkPolicy(model, dtype=torch.float32)
    policy.reset([run.prompt for run in runs])
    for t in range(max(run.num_steps for run in runs)):
        seen = [run.observation(t) if t < run.num_steps else None for run in runs]
        for run, action in zip(runs, policy.act(seen), strict=True):
            if action is not None:
                asked = run.actions[t].to_arrays()
                # Held at another point, an object moves by some centimetres, and so do free points.
                assert abs(action["pose1_position"] - asked["pose1_position"]).max() < 0.1, (run.seed, t)
