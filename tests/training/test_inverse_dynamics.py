"""Inverse dynamics: complete prompts, no leaks, and fine-tuning from other runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from openvima.cli.main import main
from openvima.data import Demonstration
from openvima.data.preprocessed import preprocess
from openvima.perception.objects import observe, whole_frames
from openvima.policies import preset
from openvima.policies.processor import Processor
from openvima.training import TrainingConfig, train
from openvima.training.augmentation.demonstrations import DemonstrationAugmentation
from openvima.training.augmentation.prompts import motion_prompt, motion_text, with_motion_prompt
from openvima.training.batches import Example
from openvima.training.building import build_learner
from openvima.training.learner import PolicyCollate
from small_networks import rngs_of

PROCESSORS = {
    name: Processor.of(preset(name).inputs) for name in ("nano", "midas-nano", "gpt-nano")
}  # objects, views, frames


def whole_motion(demo: Demonstration) -> list[dict]:
    return [demo.observation(t) for t in range(demo.num_steps + 1)]


@pytest.mark.parametrize("kind", ["objects", "frames"])
def test_the_prompt_has_every_frame_and_the_targets_every_action(
    kind, demonstrations_of_several_steps
) -> None:
    for demo in demonstrations_of_several_steps:
        motion = with_motion_prompt(preprocess(demo, kind))
        prompt = motion.prompt
        assert prompt.text == motion_text(demo.num_steps + 1)
        assert prompt.is_scene.tolist() == [True] * (demo.num_steps + 1)
        tables = prompt.objects.split(prompt.objects_per_image)
        for table, seen in zip(tables, whole_motion(demo), strict=True):
            expected = whole_frames(seen["rgb"]) if kind == "frames" else observe(seen, left_to_right=False)
            assert table.ids.tolist() == expected.ids.tolist()
            np.testing.assert_array_equal(table.boxes.swapaxes(0, 1), expected.boxes)
            np.testing.assert_array_equal(table.masks.T, expected.masks)
            np.testing.assert_array_equal(
                motion.images[table.crop_index.T[expected.masks] - 1], expected.crops[expected.masks]
            )
        actions = [np.concatenate(list(action.to_arrays().values())) for action in demo.actions]
        np.testing.assert_array_equal(motion.actions, np.float32(actions))


@pytest.mark.parametrize("name", PROCESSORS)
def test_training_and_inference_have_equal_inputs(name, demonstrations_of_several_steps) -> None:
    processor, demos = PROCESSORS[name], demonstrations_of_several_steps
    episodes = [preprocess(demo, processor.input_kind) for demo in demos]
    collate = PolicyCollate(processor, 0.0, with_images=True, augmentation=DemonstrationAugmentation(1.0))
    ours = collate([Example(episode) for episode in episodes])
    prompts = [motion_prompt(whole_motion(demo), demo.objects) for demo in demos]
    theirs, stack = processor.encode_prompts(prompts)
    for field in ("word_ids_BL", "object_index_BL", "mask_BL", "boxes_VS4", "masks_VS"):
        assert torch.equal(getattr(ours.prompts, field), getattr(theirs, field)), field
    seen = torch.from_numpy(stack.images())[theirs.crop_index_VS]
    assert torch.equal(ours.images[ours.prompts.crop_index_VS], seen)


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
    mixed = PolicyCollate(processor, 0.0, with_images=True, augmentation=DemonstrationAugmentation(0.5))
    tasks = prompts_of(PolicyCollate(processor, 0.0, with_images=True), episodes)
    motions = prompts_of(
        PolicyCollate(processor, 0.0, with_images=True, augmentation=DemonstrationAugmentation(1.0)), episodes
    )
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
    assert prompts_of(PolicyCollate(processor, 0.0, with_images=True), elsewhere) == tasks


def test_the_draw_follows_from_the_example_alone(demonstrations_of_several_steps) -> None:
    processor = PROCESSORS["nano"]
    episodes = [preprocess(demo, "objects") for demo in demonstrations_of_several_steps]
    mixed = PolicyCollate(processor, 0.0, with_images=True, augmentation=DemonstrationAugmentation(0.5))
    examples = [Example(episode) for episode in episodes]
    together = mixed(examples, rngs_of(episodes)).prompts.mask_BL.sum(1).tolist()
    assert together == [length for length, *_ in prompts_of(mixed, episodes, rngs_of(episodes))]


def test_the_best_checkpoint_is_chosen_by_tasks_unless_all_is_inverse_dynamics(
    demonstrations_of_several_steps,
) -> None:
    processor = PROCESSORS["nano"]
    episodes = [preprocess(demo, "objects") for demo in demonstrations_of_several_steps]
    plain, half, all_of_them = (
        prompts_of(
            PolicyCollate(processor, 0.0, with_images=True, augmentation=DemonstrationAugmentation(share)),
            episodes,
        )
        for share in (0.0, 0.5, 1.0)
    )
    assert half == plain != all_of_them


def last_weights(run: Path) -> dict[str, "torch.Tensor"]:
    return load_file(sorted((run / "checkpoints").glob("2-cloning-*"))[-1] / "model.safetensors")


@pytest.mark.slow
def test_init_from_loads_the_weights_of_another_run(data, tmp_path) -> None:
    words = [
        "--data",
        str(data),
        "--preset",
        "midas-nano",
        "--recipe",
        "nano",
        "--schedule.steps",
        "1",
        "--loader.batch-size",
        "2",
    ]
    before, after = str(tmp_path / "before"), str(tmp_path / "after")
    assert main(["train", *words, "--augmentation.inverse-dynamics-prob", "1", "--out", before]) == 0
    config = TrainingConfig(data=data, out=Path(after), preset="midas-nano", init_from=before)
    begun = build_learner(config).network.state_dict()
    weights = last_weights(Path(before))
    assert begun.keys() == weights.keys()
    assert all(torch.equal(begun[name], weights[name]) for name in weights)
    assert (
        main(["train", *words, "--init-from", before, "--optimizer.learning-rate", "0", "--out", after]) == 0
    )
    assert all(torch.equal(tensor, weights[name]) for name, tensor in last_weights(Path(after)).items())


@pytest.mark.parametrize("finetune", [False, True])
@pytest.mark.slow
def test_a_pretrained_encoder_is_not_pretrained_again(finetune, settings, tmp_path) -> None:
    """The crop encoder is loaded, and frozen unless it is fine-tuned."""
    first = train(TrainingConfig.of({**settings, "schedule.steps": 1}))
    again = {
        **settings,
        "pretraining.steps": None,
        "schedule.warmup_steps": 0,
        "schedule.steps": 2,
        "out": tmp_path / "on",
    }
    train(
        TrainingConfig.of({**again, "init_from": str(first), "pretraining.finetune_crop_encoder": finetune})
    )
    names = sorted(path.name for path in (tmp_path / "on" / "checkpoints").glob("*-0*"))
    assert names == ["2-cloning-000002"]
    before, after = last_weights(first), last_weights(tmp_path / "on")
    kept = {name for name in before if torch.equal(before[name], after[name])}
    crops = {name for name in before if name.startswith("images.crop_encoder")}
    assert crops and "decoder.positions.weight" not in kept
    assert crops <= kept if not finetune else not crops <= kept
