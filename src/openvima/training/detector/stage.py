"""Detector training: the split of the demonstrations, the learner, and the stage of the training loop."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from openvima.data.reader import Dataset, split_hashes
from openvima.detector.checkpoint import load_detectron2, load_network, load_weights, write_network
from openvima.detector.config import detector_config
from openvima.detector.frames import Frame, FrameSampler, augment_frame, held_out_frames
from openvima.detector.network import Instances, MaskRCNN
from openvima.errors import ConfigError, DatasetError
from openvima.multiprocess import Report
from openvima.policies.naming import WEIGHTS_FILE
from openvima.training.batches import BatchOrder
from openvima.training.detector.config import DetectorTrainingConfig
from openvima.training.learner import Learner, LossAndMetrics
from openvima.training.loop import (
    Metrics,
    Trainer,
    num_steps,
    open_run,
    step_generator,
    step_seed,
)
from openvima.training.parallel import Parallel
from openvima.training.run_folder import held_out_demonstrations
from openvima.training.source import check_scenes, open_demonstrations


def split_episodes(dataset: Dataset, fraction: float) -> tuple[np.ndarray, np.ndarray]:
    """Split demonstrations into training and validation.

    The split follows from task and seed, so that it stays the same when data are added.

    Args:
        dataset: The demonstrations.
        fraction: Fraction to hold out.

    Returns:
        Indices of both.
    """
    hashes = split_hashes(dataset.index, "detector/")
    return np.flatnonzero(hashes >= fraction), np.flatnonzero(hashes < fraction)


class DetectorLearner(Learner):
    """A Mask R-CNN, trained on frames with known objects.

    Args:
        network: The network; it is trained in place.
        sampled: Proposals of a frame that the heads are trained on.
    """

    def __init__(self, network: MaskRCNN, *, sampled: int) -> None:
        super().__init__()
        self.network = network
        self._sampled = sampled

    def forward(self, batch: tuple[Sequence[Frame], torch.Generator]) -> LossAndMetrics:
        """Return the sum of the losses, and each of them as "loss/NAME".

        Args:
            batch: Frames of one size, and what samples the anchors and proposals of the losses, on the CPU.
        """
        frames, generator = batch
        device = next(self.parameters()).device
        images = torch.from_numpy(np.stack([frame.rgb for frame in frames])).to(device)
        objects = [
            Instances(
                torch.from_numpy(frame.boxes), torch.from_numpy(frame.masks), torch.ones(len(frame.boxes))
            ).to(device)
            for frame in frames
        ]
        losses = self.network.losses(images, objects, sampled=self._sampled, generator=generator)
        parts = {f"loss/{name}": value.detach() for name, value in losses.items()}
        return torch.stack(list(losses.values())).sum(), parts

    def write(self, folder: Path) -> None:
        """Write a checkpoint that `load_detector` takes."""
        write_network(self.network, folder)

    def read(self, folder: Path) -> None:
        """Load the weights of a checkpoint."""
        load_weights(self.network, folder / WEIGHTS_FILE)

    def description(self) -> dict[str, Any]:
        """Return all sizes of the network."""
        return self.network.config.to_dict()


VALIDATION_BATCH = 8  # frames


def train_detector(config: DetectorTrainingConfig, report: Report | None = None) -> Path:
    """Train a detector on the segmentation of demonstrations, or resume an interrupted run.

    Args:
        config: All settings.
        report: Called with steps done, steps in all, and a note.

    Returns:
        The run folder; `load_detector` takes it.

    Raises:
        ConfigError: The folder holds a run with other settings, the loss diverged, or there are several
            processes.
        DatasetError: There are not enough demonstrations, or some are held out for evaluation.
        InputFileError: The last checkpoint, or the initial one, is damaged.
        FolderLockedError: Another run writes to the folder.
    """
    dataset, loader = open_demonstrations(config.data, allow_heldout=config.allow_heldout), config.loader
    if loader.rerendered_prob:
        check_scenes(dataset)
    training, held_out = split_episodes(dataset, loader.validation_fraction)
    if 2 * len(training) < loader.batch_size or not len(held_out):
        raise DatasetError(
            f"{config.data} holds {len(training)} demonstrations to train on and {len(held_out)} for "
            f"validation; a batch of {loader.batch_size} frames needs {loader.batch_size // 2} and 1. "
            "Generate more, lower loader.batch_size, or raise loader.validation_fraction."
        )
    with open_run(config) as parallel:
        if parallel.num_ranks > 1:
            raise ConfigError("a detector trains in one process; start it without torchrun.")
        learner = DetectorLearner(_network(config), sampled=config.proposals_per_frame)
        found = held_out_demonstrations(dataset)
        origin = {"held_out": found} if found else None
        trainer = Trainer(config, dataset, learner, parallel, report=report, demonstrations=origin)
        learner.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it

        def make() -> DetectorStage:
            probs = {"prompt_prob": loader.prompt_prob, "rerendered_prob": loader.rerendered_prob}
            source, kept = (FrameSampler(dataset, rows, **probs) for rows in (training, held_out))
            frames = list(held_out_frames(kept, loader.validation_frames, seed=config.seed))
            return DetectorStage(learner, config, source, frames, parallel)

        steps = num_steps(config.schedule, lambda: len(training), loader.batch_size // 2)
        return trainer.train([(steps, make)])


class DetectorStage:
    """Minimises the losses of Mask R-CNN over frames with known objects.

    Args:
        learner: The trained module.
        config: All settings.
        source: Frames to train on.
        held_out: Validation frames.
        parallel: The process of the run.
    """

    name = "detector"

    def __init__(
        self,
        learner: DetectorLearner,
        config: DetectorTrainingConfig,
        source: FrameSampler,
        held_out: Sequence[Frame],
        parallel: Parallel,
    ) -> None:
        self.learning_rate = config.optimizer.learning_rate
        self.parameters = list(learner.parameters())
        self._learner, self._config, self._parallel = learner, config, parallel
        self._source, self._held_out = source, held_out
        self._order = BatchOrder(len(source), batch_size=config.loader.batch_size // 2, seed=config.seed)

    def backward(self, step: int) -> Metrics:
        """Add the gradients of one batch of frames, in parts."""
        frames, sums = self._frames(step), Metrics()
        generator = step_generator(self._config.seed, "boxes of the losses", step)
        size = -(-len(frames) // self._config.optimizer.grad_accum_steps)
        for start in range(0, len(frames), size):
            part = frames[start : start + size]
            self._add(sums, part, generator, len(part) / len(frames)).backward()
        return sums

    @torch.no_grad()
    def validate(self) -> Metrics:
        """Return the losses on held-out frames; the score is the negative loss."""
        frames, sums = self._held_out, Metrics()
        for start in range(0, len(frames), VALIDATION_BATCH):
            part = frames[start : start + VALIDATION_BATCH]
            generator = step_generator(self._config.seed, "boxes of the validation", start)
            self._add(sums, part, generator, len(part) / len(frames))
        return {**sums, "score": -sums["loss"]}

    def _add(
        self, sums: Metrics, frames: Sequence[Frame], generator: torch.Generator, weight: float
    ) -> torch.Tensor:
        """Add the weighted losses of some frames to sums, and return the weighted loss."""
        with self._parallel.autocast(self._config.runtime.precision):
            loss, losses = self._learner((frames, generator))
        for name, value in {"loss": loss, **losses}.items():
            sums[name] = sums.get(name, 0.0) + value.item() * weight
        return loss * weight

    def _frames(self, step: int) -> list[Frame]:
        frames, loader = [], self._config.loader
        for row in self._order.rows(step).tolist():
            rng = np.random.default_rng([self._config.seed, step, row])
            drawn = self._source.sample(row, rng)
            if loader.augment:
                drawn = [augment_frame(frame, rng, paste_prob=loader.paste_prob) for frame in drawn]
            frames += drawn
        return frames


def _network(config: DetectorTrainingConfig) -> MaskRCNN:
    """Build the network, with the weights of `init_from` if given."""
    if config.init_from is not None:
        is_file = config.init_from.is_file()
        return load_detectron2(config.init_from) if is_file else load_network(config.init_from)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_seed(config.seed, "weights", 0))
        return MaskRCNN(detector_config(config.preset))
