"""Retrieval and rotation accuracy of a crop encoder on unseen scenes.

    python benchmarks/crops.py --policy RUN [--scenes N] [--json FILE]

Retrieval: fraction of prompt images, and of objects in a rearranged view of the scene, whose nearest object
of the scene is right. Rotation: fraction of objects whose rotation between the two views is estimated within
15 degrees; 10 % at random. Training scenes are sampled with other seeds. Scenes of one shape contain it in
three textures of all light ones, rotated at random, flat on the table, as in `twist`; letter R is in no
training partition.
"""

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import TEXTURE_SETS, tasks_at
from openvima.policies.checkpoint import load_network
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Placement, Pose, Scene
from openvima.training.augmentation.scenes import rearrange
from openvima.training.config import PretrainingConfig
from openvima.training.pretraining.losses import retrieval_accuracy, rotation_accuracy
from openvima.training.pretraining.pairs import (
    Pairs,
    pairs_of_scene,
    render_pairs,
    stack_rows,
)
from sim import circumstances

SEED = 7_000_000  # no run is likely to have it
SHAPES = ("letter A", "letter G", "heart", "letter R")  # the last is novel
POSITIONS_Y = (-0.25, 0.0, 0.25)  # m
AUGMENTATIONS = {
    "training partition": PretrainingConfig(),
    "with hard negatives": PretrainingConfig(hard_negative_prob=0.5),
    "with random appearance as well": PretrainingConfig(
        appearance_randomization_prob=0.5, hard_negative_prob=0.5
    ),
}


def scenes_of(shape: str, num_scenes: int) -> Pairs:
    """Render scenes of one shape, each with a rearranged view."""
    rng = np.random.default_rng([SEED, *shape.encode()])
    rasteriser = Rasteriser(load_assets("procedural"))
    rows: list[tuple] = []
    for number in range(num_scenes):
        textures = rng.choice(TEXTURE_SETS["T"], size=len(POSITIONS_Y), replace=False)
        scene = Scene(
            tuple(
                Placement(5 + k, shape, str(textures[k]), (0.0, 0.0, 0.0), _lying(y, rng))
                for k, y in enumerate(POSITIONS_Y)
            )
        )
        rows += pairs_of_scene(scene, {}, rasteriser, number, rearrange(scene, rng))
    return stack_rows(rows)


def _lying(y: float, rng: np.random.Generator) -> Pose:
    x, y = rng.uniform(0.4, 0.6), y + rng.uniform(-0.05, 0.05)
    return Pose.planar(x, y, rng.uniform(0, 2 * np.pi))


def all_pairs(num_scenes: int) -> Iterator[tuple[str, Pairs]]:
    """Render all kinds of scenes, by their names in the table."""
    for name, augmentation in AUGMENTATIONS.items():
        tasks = tasks_at("train")
        yield (
            name,
            render_pairs(
                tasks,
                replace(augmentation, num_scenes=num_scenes),
                seed=SEED,
                assets="procedural",
                second_view=True,
            ),
        )
    for shape in SHAPES:
        yield shape, scenes_of(shape, num_scenes)


def main() -> None:
    """Measure one policy and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--policy", required=True, help="run folder or checkpoint")
    parser.add_argument("--scenes", type=int, default=300, help="of each kind")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    network, _ = load_network(arguments.policy)
    encoder = network.object_encoder
    if encoder is None:
        parser.error(f"{arguments.policy} encodes no crops.")
    results: dict[str, dict[str, float]] = {}
    keys = ("prompt", "second_view", "rotation")
    print(f"{'scenes':<31}{'objects':>9}" + "".join(f"{key:>13}" for key in keys))
    for name, pairs in all_pairs(arguments.scenes):
        results[name] = {
            "objects": len(pairs.scenes),
            "prompt": retrieval_accuracy(encoder, pairs),
            "second_view": retrieval_accuracy(encoder, pairs.second_view_pairs()),
            **({"rotation": rotation_accuracy(encoder, pairs)} if encoder.config.rotation_bins else {}),
        }
        accuracies = "".join(f"{results[name].get(key, float('nan')):>13.1%}" for key in keys)
        print(f"{name:<31}{len(pairs.scenes):>9}{accuracies}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({**circumstances(), "results": results}, indent=2) + "\n")


if __name__ == "__main__":
    main()
