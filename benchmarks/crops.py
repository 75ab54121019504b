"""How well a crop encoder matches looks and tells turns, on scenes that it has not seen.

    python benchmarks/crops.py --policy RUN [--scenes N] [--json FILE]

Looks: the share of prompt images, and of objects in the same scene laid again, whose object is the most
similar one of its scene. Turns: the share of objects laid again whose likeliest turn is right within 15
degrees; by chance 10 %. Scenes of training are drawn with other seeds. Scenes of one shape hold it in three
textures of all light ones, turned at random, flat on the table, as in `twist`; letter R is in
no training partition.
"""

import argparse
import json
import os
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import TEXTURE_SETS, tasks_at
from openvima.policies.checkpoint import load_network
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Placement, Pose, Scene
from openvima.training.pretrain import (
    Pairs,
    Variety,
    pairs_again,
    pairs_of_scene,
    render_pairs,
    scene_accuracy,
    stacked,
)
from openvima.training.scene_variants import laid_again
from openvima.training.turning import turn_accuracy
from sim import circumstances

SEED = 7_000_000  # no run is likely to have it
SHAPES = ("letter A", "letter G", "heart", "letter R")  # the last is novel
PLACES_Y = (-0.25, 0.0, 0.25)  # m
VARIETIES = {
    "training partition": Variety(again=True),
    "with twins": Variety(twins=0.5, again=True),
    "with random looks and twins": Variety(random_looks=0.5, twins=0.5, again=True),
}


def scenes_of(shape: str, num_scenes: int) -> Pairs:
    """Draw scenes of one shape, each laid twice."""
    rng = np.random.default_rng([SEED, *shape.encode()])
    rasteriser = Rasteriser(load_assets("procedural"))
    rows: list[tuple] = []
    looks: dict[tuple, int] = {}
    for number in range(num_scenes):
        textures = rng.choice(TEXTURE_SETS["T"], size=len(PLACES_Y), replace=False)
        scene = Scene(
            tuple(
                Placement(5 + k, shape, str(textures[k]), (0.0, 0.0, 0.0), _lying(y, rng))
                for k, y in enumerate(PLACES_Y)
            )
        )
        rows += pairs_of_scene(scene, {}, rasteriser, looks, number, laid_again(scene, rng))
    return stacked(rows)


def _lying(y: float, rng: np.random.Generator) -> Pose:
    x, y = rng.uniform(0.4, 0.6), y + rng.uniform(-0.05, 0.05)
    return Pose.planar(x, y, rng.uniform(0, 2 * np.pi))


def all_pairs(num_scenes: int) -> Iterator[tuple[str, Pairs]]:
    """Draw what is looked at, under the names of the table."""
    for name, variety in VARIETIES.items():
        tasks = tasks_at("train")
        yield (
            name,
            render_pairs(tasks, num_scenes=num_scenes, seed=SEED, assets="procedural", variety=variety),
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
    if encoder is None or not encoder.config.appearance_width:
        parser.error(f"{arguments.policy} has no appearance embedding.")
    results: dict[str, dict[str, float]] = {}
    print(f"{'scenes':<30}{'objects':>9}{'prompt':>9}{'again':>9}{'turn':>9}")
    for name, pairs in all_pairs(arguments.scenes):
        assert pairs.again is not None
        results[name] = {
            "objects": len(pairs.looks),
            "prompt": scene_accuracy(encoder, pairs),
            "again": scene_accuracy(encoder, pairs_again(pairs, pairs.again)),
            **({"turn": turn_accuracy(encoder, pairs)} if encoder.config.rotation_bins else {}),
        }
        shares = "".join(
            f"{results[name].get(key, float('nan')):>9.1%}" for key in ("prompt", "again", "turn")
        )
        print(f"{name:<30}{len(pairs.looks):>9}{shares}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({**circumstances(), "results": results}, indent=2) + "\n")


if __name__ == "__main__":
    main()
