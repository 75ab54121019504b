"""Speed of contrastive pretraining by the recipe `small`, on one CPU core: rendering, and steps.

    python benchmarks/pretraining.py [--scenes N] [--batch K] [--rounds R] [--json FILE]

Crop encoders of several sizes (channels of the first layer, kernel of the last one) take steps in turns, on
the same batches; a first round warms up. Times are CPU time, medians. "augmentation" is that of a batch,
"encoder" forward and backward passes of the crop encoder alone; most of what remains of a step is losses.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

from openvima.catalog.partitions import tasks_at
from openvima.policies.build import build_network
from openvima.policies.pointer.config import small
from openvima.policies.tokenizer import Vocabulary, WordTokenizer
from openvima.policies.variants import with_variant
from openvima.training import TrainingConfig
from openvima.training.augmentation.crops import with_box_jitter, with_horizontal_flips, with_occlusion
from openvima.training.parallel import ONE_PROCESS
from openvima.training.pretraining.pairs import Pairs, SceneAugmentation, render_pairs
from openvima.training.pretraining.stage import ContrastivePretraining, caption_texts
from openvima.training.recipes import recipe_settings
from sim import circumstances

ENCODERS = ((48, 3), (48, 1), (32, 1))


def augmented(pairs: Pairs, config: TrainingConfig) -> Pairs:
    """Augment a batch as the stage does."""
    generator, settings = torch.Generator().manual_seed(0), config.pretraining
    pairs = with_occlusion(with_horizontal_flips(pairs, generator), settings.occlusion_prob, generator)
    return with_box_jitter(pairs, settings.box_jitter_px, generator)


def measure(num_scenes: int, batch: int, num_rounds: int) -> dict[str, float]:
    """Measure everything, in milliseconds."""
    settings = {**recipe_settings("small"), "pretraining.batch_size": batch}
    config = TrainingConfig.of({**settings, "data": Path(), "out": Path()})
    augmentation = SceneAugmentation.of(config.pretraining, second_view=True)

    def rendered(count: int) -> Pairs:
        return render_pairs(
            tasks_at("train"),
            num_scenes=count,
            seed=0,
            assets="procedural",
            augmentation=augmentation,
            with_attributes=True,
        )

    rendered(2)  # compiles
    start = time.process_time()
    pairs = rendered(num_scenes)
    found = {"scene_ms": 1000 * (time.process_time() - start) / num_scenes, "objects": len(pairs.scenes)}
    tokenizer = WordTokenizer(Vocabulary().extended(caption_texts()))
    times: dict[str, list[float]] = {}
    stages = {}
    for width, kernel in ENCODERS:
        sizes = with_variant(small(), {"crop_width": width, "crop_kernel": kernel})
        stages[f"{width}_channels_kernel_{kernel}"] = ContrastivePretraining(
            build_network(sizes, seed=0), config.pretraining, 0, pairs, ONE_PROCESS, tokenizer.encode
        )
    part = pairs.select(torch.arange(batch))
    crops = torch.cat([augmented(part, config).scene_crops] * 3)

    def encode(stage: ContrastivePretraining) -> None:
        stage.encoder.encode_images(crops).sum().backward()

    works: dict[str, Callable[[int], object]] = {"augmentation_ms": lambda _: augmented(part, config)}
    for name, stage in stages.items():
        works[f"step_ms_{name}"] = stage.backward
        works[f"encoder_ms_{name}"] = lambda _, stage=stage: encode(stage)
    for number in range(num_rounds + 1):
        for name, work in works.items():
            start = time.process_time()
            work(number)
            times.setdefault(name, []).append(1000 * (time.process_time() - start))
    return found | {name: statistics.median(each[1:]) for name, each in times.items()}


def main() -> None:
    """Measure, print, and write JSON if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=200, help="scenes to render")
    parser.add_argument("--batch", type=int, default=128, help="object pairs a step")
    parser.add_argument("--rounds", type=int, default=5, help="rounds, after a first that warms up")
    parser.add_argument("--json", type=Path, help="file to write")
    given = parser.parse_args()
    torch.set_num_threads(1)
    result = {
        name: round(value, 1) for name, value in measure(given.scenes, given.batch, given.rounds).items()
    }
    for name, value in result.items():
        print(f"{name:36}{value:10.1f}")
    if given.json:
        given.json.write_text(json.dumps(result | circumstances(), indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
