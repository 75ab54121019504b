"""Render times of observations, prompt images and label rasters, on one core.

    python benchmarks/render.py [--assets procedural|CHECKOUT] [--rounds R] [--json FILE]

One observation is RGB and segmentation of both views. Scenes are objects at random places: few small ones,
the bodies with most triangles, and so on. Compilation and building of shapes and textures are excluded.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from openvima.catalog import TEXTURES, Assets, object_spec
from openvima.catalog.packs import load_assets
from openvima.render import Rasteriser, label_raster
from openvima.scene import ObjectImage, Placement, Pose, Prompt, Scene, SceneImage
from sim import circumstances

SCENES: dict[str, tuple[str, ...]] = {
    "two letters": ("letter A", "letter G"),
    "frame, two kit objects": ("frame", "ring", "heart"),
    "bowl, three kit objects": ("bowl", "flower", "star", "letter R"),
    "pan, pallet, two kit objects": ("pan", "pallet", "ring", "cross"),
    "sweep, eight blocks": ("three-sided rectangle", "line", *["small block"] * 8),
    "six bowls": ("bowl",) * 6,
}
CALLS_PER_ROUND = 20


def random_scene(names: tuple[str, ...], assets: Assets, rng: np.random.Generator) -> Scene:
    """Lay catalogue objects onto the table at random, with random textures; they may overlap."""
    placements = []
    for object_id, name in enumerate(names, start=5):
        size = object_spec(name).size_max
        x, y, yaw_rad = rng.uniform((0.35, -0.35, -np.pi), (0.65, 0.35, np.pi))
        pose = Pose.planar(x, y, yaw_rad, z=assets.geometry(name, size).rest_z_m)
        placements.append(Placement(object_id, name, str(rng.choice(list(TEXTURES))), size, pose))
    return Scene(tuple(placements))


def milliseconds(work: Callable[[], object]) -> float:
    """Time of one call, mean over a round."""
    start = time.perf_counter()
    for _ in range(CALLS_PER_ROUND):
        work()
    return 1e3 * (time.perf_counter() - start) / CALLS_PER_ROUND


def measure(assets: Assets, num_rounds: int) -> dict[str, dict[str, float]]:
    """Time all scenes in alternating rounds; return the median milliseconds by scene and kind of image."""
    rasteriser = Rasteriser(assets)
    rng = np.random.default_rng(0)
    works: dict[tuple[str, str], Callable[[], object]] = {}
    num_triangles = {}
    for title, names in SCENES.items():
        scene = random_scene(names, assets, rng)
        lone = Prompt("{a}", (("a", ObjectImage(scene.placements[0])),))
        whole = Prompt("{s}", (("s", SceneImage.of(scene.placements)),))
        works[title, "observation"] = lambda scene=scene: rasteriser.scene(scene)
        works[title, "object image"] = lambda prompt=lone: rasteriser.prompt(prompt)
        works[title, "scene image"] = lambda prompt=whole: rasteriser.prompt(prompt)
        works[title, "label raster"] = lambda scene=scene: label_raster(scene, assets)
        num_triangles[title] = sum(
            len(assets.geometry(p.object, p.size).visual.vertices) for p in scene.placements
        )
    times: dict[tuple[str, str], list[float]] = {key: [] for key in works}
    for round_number in range(num_rounds + 1):
        for key, work in works.items():
            elapsed = milliseconds(work)
            if round_number:  # the first one warms up
                times[key].append(elapsed)
    result: dict[str, dict[str, float]] = {title: {"triangles": num_triangles[title]} for title in SCENES}
    for (title, kind), values in times.items():
        result[title][kind] = statistics.median(values)
    return result


def main() -> None:
    """Measure, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--assets", default="procedural", help="procedural, or a checkout of VIMABench")
    parser.add_argument("--rounds", type=int, default=15, help=f"rounds of {CALLS_PER_ROUND} calls each")
    parser.add_argument("--json", type=Path, help="file to write the result to")
    arguments = parser.parse_args()
    assets = load_assets(arguments.assets)
    scenes = measure(assets, arguments.rounds)
    kinds = ("observation", "object image", "scene image", "label raster")
    print(f"milliseconds, pack {assets.name}")
    print(f"{'scene':30} {'triangles':>9} " + " ".join(f"{kind:>13}" for kind in kinds))
    for title, row in scenes.items():
        print(f"{title:30} {row['triangles']:9.0f} " + " ".join(f"{row[kind]:13.3f}" for kind in kinds))
    observation = statistics.geometric_mean(row["observation"] for row in scenes.values())
    print(f"one observation, geometric mean: {observation:.3f} ms")
    if arguments.json:
        result = {"observation_ms": observation, "assets": assets.name, "scenes": scenes, **circumstances()}
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
