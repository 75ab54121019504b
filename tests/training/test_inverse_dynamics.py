"""Inverse dynamics: complete prompts, no leaks, and fine-tuning from other runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from openvima.data import Demonstration
from openvima.data.preprocessed import preprocess
from openvima.policies import preset
from openvima.policies.processor import Processor
from openvima.training import TrainingConfig, train
from openvima.training.batches import BatchMaker, Example
from openvima.training.config import AugmentationConfig
from openvima.training.learner import PolicyCollate
from small_networks import rngs_of, source_of_episodes

PROCESSORS = {name: Processor(*preset(name).inputs) for name in ("nano", "midas-nano")}  # objects, views


def whole_motion(demo: Demonstration) -> list[dict]:
    return [demo.observation(t) for t in range(demo.num_steps + 1)]


def collate_of(processor: Processor, share: float) -> PolicyCollate:
    """With motions in place of such a share of the prompts."""
    augmentation = AugmentationConfig(inverse_dynamics_prob=share)
    return PolicyCollate(processor, 0.0, with_images=True, augmentation=augmentation)


def prompts_of(collate: PolicyCollate, episodes, rngs=None) -> list[tuple]:
    """The prompt of each demonstration, collated by itself."""
    found = []
    for number, episode in enumerate(episodes):
        batch = collate([Example(episode, row=number)], None if rngs is None else rngs[number : number + 1])
        length = int(batch.prompts.mask_BL.sum())
        crops = batch.images[batch.prompts.crop_index_VS].sum().item()
        found.append((length, batch.prompts.word_ids_BL.tolist(), batch.prompts.boxes_VS4.tolist(), crops))
    return found


def test_no_target_leaks_into_the_prompt_of_a_task(demonstrations_of_several_steps) -> None:
    """Prompts of tasks in a mixed batch do not depend on the actions."""
    processor = PROCESSORS["midas-nano"]
    episodes = [preprocess(demo, "objects") for demo in demonstrations_of_several_steps] * 4
    mixed = collate_of(processor, 0.5)
    tasks = prompts_of(collate_of(processor, 0.0), episodes)
    motions = prompts_of(collate_of(processor, 1.0), episodes)
    with_motions = prompts_of(mixed, episodes, rngs_of(episodes))
    are_motions = [prompt == motion for prompt, motion in zip(with_motions, motions, strict=True)]
    assert 4 < sum(are_motions) < len(episodes) - 4
    for prompt, task, is_motion in zip(with_motions, tasks, are_motions, strict=True):
        assert is_motion or prompt == task
        assert task not in motions
    elsewhere = [
        replace(
            tokens,
            actions=tokens.actions[::-1] + 0.1,
            objects=tokens.objects.select(np.zeros(len(tokens.objects), np.int64)),
            final=tokens.final.select(slice(0)),
        )
        for tokens in episodes
    ]
    assert prompts_of(collate_of(processor, 0.0), elsewhere) == tasks


def test_the_draw_follows_from_the_example_alone(demonstrations_of_several_steps) -> None:
    processor = PROCESSORS["nano"]
    episodes = [preprocess(demo, "objects") for demo in demonstrations_of_several_steps]
    mixed = collate_of(processor, 0.5)
    examples = [Example(episode) for episode in episodes]
    together = mixed(examples, rngs_of(episodes)).prompts.mask_BL.sum(1).tolist()
    assert together == [length for length, *_ in prompts_of(mixed, episodes, rngs_of(episodes))]


def test_demonstrations_of_the_first_batches_keep_their_prompts(demonstrations_of_several_steps) -> None:
    source = source_of_episodes([preprocess(demo, "objects") for demo in demonstrations_of_several_steps])

    def words(share: float, number: int) -> list[list]:
        make = BatchMaker(source, collate_of(PROCESSORS["nano"], share), 0, 99, first_batches=5)
        parts = make(np.arange(len(source)), number)
        return [batch.prompts.word_ids_BL.tolist() for batch, _ in parts]

    assert words(0.9, 4) == words(0.0, 4)
    assert words(0.9, 5) != words(0.0, 5)


def test_the_best_checkpoint_is_chosen_by_tasks_unless_all_is_inverse_dynamics(
    demonstrations_of_several_steps,
) -> None:
    processor = PROCESSORS["nano"]
    episodes = [preprocess(demo, "objects") for demo in demonstrations_of_several_steps]
    plain, half, all_of_them = (
        prompts_of(collate_of(processor, share), episodes) for share in (0.0, 0.5, 1.0)
    )
    assert half == plain != all_of_them


def last_weights(run: Path) -> dict[str, "torch.Tensor"]:
    return load_file(sorted((run / "checkpoints").glob("2-cloning-*"))[-1] / "model.safetensors")


@pytest.mark.slow
def test_a_pretrained_encoder_is_not_pretrained_again(settings, tmp_path) -> None:
    """The crop encoder is loaded and frozen."""
    first = train(TrainingConfig.of({**settings, "schedule.steps": 1}))
    again = {
        **settings,
        "pretraining.steps": None,
        "schedule.warmup_steps": 0,
        "schedule.steps": 2,
        "out": tmp_path / "on",
    }
    train(TrainingConfig.of({**again, "init_from": str(first), "pretraining.finetune_crop_encoder": False}))
    names = sorted(path.name for path in (tmp_path / "on" / "checkpoints").glob("*-0*"))
    assert names == ["2-cloning-000002"]
    before, after = last_weights(first), last_weights(tmp_path / "on")
    kept = {name for name in before if torch.equal(before[name], after[name])}
    crops = {name for name in before if name.startswith("images.crop_encoder")}
    assert crops and "decoder.positions.weight" not in kept
    assert crops <= kept
