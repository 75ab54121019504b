"""Small networks and inputs for tests of policies and training."""

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.data import Demonstration
from openvima.data.preprocessed import PreprocessedEpisode, number_images, preprocess
from openvima.detector.config import BackboneConfig, DetectorConfig
from openvima.policies.batch import Batch
from openvima.policies.nn.image_encoders import ConvConfig
from openvima.policies.pointer.config import CorrespondenceConfig, PointerConfig, small
from openvima.policies.pointer.correspondence import ObjectFeatures
from openvima.policies.pointer.inputs import ObjectSet, PointerPrompt
from openvima.policies.processor import Processor
from openvima.training import TrainingConfig, train
from openvima.training.batches import Example, ExampleSource


def narrow_small(width: int = 32, crop_width: int = 4) -> PointerConfig:
    """The preset small, narrower and shallower, without attributes."""
    sizes = small()
    text = replace(sizes.prompt.text, width=width, num_layers=1, num_heads=2, head_width=16, hidden_width=32)
    crop = ConvConfig(width=crop_width, output_width=4 * crop_width)
    return replace(
        sizes,
        images=replace(sizes.images, crop=crop, box_width=16, width=width),
        prompt=replace(sizes.prompt, text=text, image_width=width),
        decoder=replace(sizes.decoder, width=width, num_layers=1, num_self_heads=2, num_cross_heads=2),
        head=replace(sizes.head, hidden_width=32),
        correspondence=CorrespondenceConfig(hidden_width=32),
        attributes=None,
    )


def one_level_detector() -> DetectorConfig:
    """Sizes of a detector that trains in moments."""
    return DetectorConfig(
        BackboneConfig("basic", (1,), (8,), stem_width=4, stem_kernel=3, fpn_width=8),
        (32.0,),
        box_head_widths=(8,),
        mask_head_widths=(8,),
        rpn_post_nms_top_n=4,
        rpn_pre_nms_top_n=8,
    )


def object_set(
    tokens_BKD: torch.Tensor,
    appearance_BKA: torch.Tensor,
    positions_BK2: torch.Tensor,
    rotation_bins: int = 0,
) -> ObjectSet:
    """Objects that all exist, each in an image of its own."""
    batch, count = tokens_BKD.shape[:2]
    return ObjectSet(
        tokens_BKD,
        torch.ones(batch, count, dtype=torch.bool),
        appearance_BKA,
        positions_BK2,
        torch.arange(count).expand(batch, count),
        tokens_BKD.new_zeros(batch, count, rotation_bins),
    )


def pointer_prompt(
    masked_BLD: torch.Tensor, appearance_BLA: torch.Tensor, object_mask_BL: torch.Tensor, objects: ObjectSet
) -> PointerPrompt:
    """An encoded prompt whose heads-only parts are given; no word describes anything."""
    batch, length, width = masked_BLD.shape[0], masked_BLD.shape[1], appearance_BLA.shape[-1]
    none = ObjectFeatures(
        masked_BLD.new_zeros(batch, 2, 0, 1),
        torch.zeros(batch, 2, 0, 4, dtype=torch.int64),
        torch.zeros(batch, 2, 0, dtype=torch.bool),
        masked_BLD.new_zeros(batch, 0, width),
        masked_BLD.new_zeros(batch, 0, 2),
        torch.zeros(batch, 0, dtype=torch.bool),
        torch.zeros(batch, 0, dtype=torch.int64),
    )
    return PointerPrompt(
        masked_BLD,
        masked_BLD,
        torch.ones(batch, length, dtype=torch.bool),
        object_mask_BL,
        appearance_BLA,
        torch.zeros_like(appearance_BLA),
        none,
        objects,
    )


def stack_images(episodes: list[PreprocessedEpisode]) -> tuple[list[Example], torch.Tensor]:
    """Examples that share a stack of images, and the stack."""
    images = [episode.images for episode in episodes]
    bases = np.cumsum([0, *map(len, images)])[:-1].tolist()
    stack = np.concatenate([np.zeros_like(images[0][:1]), *images])
    return [Example(*pair) for pair in zip(episodes, bases, strict=True)], torch.from_numpy(stack)


def examples_of(demos: Iterable[Demonstration], processor: Processor):
    """The same of demonstrations."""
    return stack_images([preprocess(demo, processor.input_kind) for demo in demos])


def source_of(demos: Iterable[Demonstration], processor: Processor) -> ExampleSource:
    """The same as if they had been read from an object cache."""
    return source_of_episodes([preprocess(demo, processor.input_kind) for demo in demos])


def source_of_episodes(episodes: list[PreprocessedEpisode]) -> ExampleSource:
    """Preprocessed demonstrations as if they had been read from an object cache."""
    counts = np.array([len(episode.images) for episode in episodes])
    lengths = np.array([[episode.num_steps, len(episode.objects)] for episode in episodes])
    return ExampleSource(episodes, np.arange(len(episodes)), np.cumsum(counts) - counts, lengths)


def collate_examples(processor: Processor, examples: Iterable[Example]) -> Batch:
    """A batch whose images are numbered as in the examples' stack."""
    examples = list(examples)
    return processor.collate(number_images([e.episode for e in examples], [e.base for e in examples]))


def rngs_of(examples: list[Example], seed: int = 0) -> list[np.random.Generator]:
    """A generator for each example."""
    return [np.random.default_rng([seed, number]) for number in range(len(examples))]


class Killed(BaseException):
    """Stands for a kill signal."""


def check_mixed_precision(network: torch.nn.Module, loss: Callable[[], torch.Tensor]) -> None:
    """A loss in mixed precision is nearly that in float32, and its gradients are finite."""
    with torch.autocast("cpu", torch.bfloat16):
        mixed = loss()
    torch.testing.assert_close(mixed.float(), loss(), rtol=0.05, atol=0.05)
    mixed.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


def train_until(config: TrainingConfig, step: int) -> None:
    """Train and be killed when so many steps have been begun; nothing is tidied up."""
    from openvima.training import loop, policy

    begun = 0

    class Trainer(loop.Trainer):
        def _step(self, *arguments):
            nonlocal begun
            begun += 1
            if begun > step:
                raise Killed
            return super()._step(*arguments)

    with pytest.MonkeyPatch.context() as patched, pytest.raises(Killed):
        patched.setattr(policy, "Trainer", Trainer)
        train(config)
