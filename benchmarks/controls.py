"""What guesses solve at a level: controls that read no prompt, or no words of it.

    python benchmarks/controls.py [--levels L5,L8] [--tasks T,…] [--episodes N] [--seed S] [--json FILE]

guess    Any object that can be moved goes to any that cannot, without rotation; where there is none, to any
         place on the table. Reads no prompt.
first    The same, objects by ascending id: what order and ids give away.
similar  The objects that look most like the images of the prompt, in their order, go to the fixed ones that
         look most like its images; of a scene image, to their places in the last one. Reads no words, and
         compares true shapes and textures, so it mistakes none.

Each goes on until the episode ends. Intervals are Wilson's at 95 %.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.env import TabletopEnv
from openvima.env.config import EnvConfig
from openvima.errors import OracleError
from openvima.evaluation.rollout import play
from openvima.evaluation.statistics import wilson_interval
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Action, ObjectImage, Placement, SceneImage
from openvima.tasks.oracle import visible_point
from openvima.tasks.registry import tasks_of
from sim import circumstances

WAYS = ("guess", "first", "similar")
Point = tuple[float, float]


class Guess:
    """Moves objects in one of `WAYS`.

    Args:
        way: Which one.
        rng: Draws what is not decided.
    """

    modalities = ("segm",)

    def __init__(self, way: str, rng: np.random.Generator) -> None:
        self._way, self._rng = way, rng
        self._envs: Sequence[TabletopEnv] = ()
        self._step = -1

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start a batch of episodes."""
        self._envs, self._step = envs, -1

    def decide(self, observations: Sequence[Mapping | None]) -> list[Action | None]:
        """Move one object in each environment that runs."""
        self._step += 1
        pairs = zip(self._envs, observations, strict=True)
        return [None if seen is None else self._move(env) for env, seen in pairs]

    def near_ties(self) -> Sequence[bool]:
        """Return nothing: there are no scores."""
        return ()

    def _move(self, env: TabletopEnv) -> Action:
        loose = [p for p in env.scene.placements if not p.fixed]
        fixed = [p for p in env.scene.placements if p.fixed]
        x, y = self._rng.uniform(WORKSPACE_LOW, WORKSPACE_HIGH).tolist()
        if self._way == "similar":
            picked, place = self._by_images(env, loose, fixed) or (loose[0], (x, y))
        elif self._way == "first":
            picked = loose[self._step % len(loose)]
            place = (fixed[0].pose.x, fixed[0].pose.y) if fixed else (x, y)
        else:
            picked = loose[int(self._rng.integers(len(loose)))]
            base = fixed[int(self._rng.integers(len(fixed)))] if fixed else None
            place = (base.pose.x, base.pose.y) if base else (x, y)
        try:
            point = visible_point(env.scene, picked.id, assets=env.assets)
        except OracleError:  # another object lies on it, or it left the table
            point = (x, y)
        return Action.planar(point, place)

    def _by_images(
        self, env: TabletopEnv, loose: list[Placement], fixed: list[Placement]
    ) -> tuple[Placement, Point] | None:
        fills = [fill for _, fill in env.episode.problem.prompt.images]
        scenes = [fill.scene for fill in fills if isinstance(fill, SceneImage)]
        if scenes:
            shown = scenes[-1].placements[self._step % len(scenes[-1].placements)]
            return max(loose, key=lambda p: likeness(p, shown)), (shown.pose.x, shown.pose.y)
        images = [fill.placement for fill in fills if isinstance(fill, ObjectImage)]
        of_fixed = [i for i in images if any(likeness(p, i) >= 2 for p in fixed)]
        of_loose = [i for i in images if i not in of_fixed]
        if not of_loose:
            return None
        picked = max(loose, key=lambda p: likeness(p, of_loose[self._step % len(of_loose)]))
        if not of_fixed:
            return picked, (picked.pose.x, picked.pose.y)
        base = max(fixed, key=lambda p: likeness(p, of_fixed[self._step % len(of_fixed)]))
        return picked, (base.pose.x, base.pose.y)


def likeness(placement: Placement, image: Placement) -> int:
    """How many of shape and texture are equal; of a gray image the texture is."""
    same_texture = image.texture in (placement.texture, NEUTRAL_TEXTURE)
    return (placement.object == image.object) + same_texture


def main() -> None:
    """Play and print the rows."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--levels", default="L5,L8")
    parser.add_argument("--tasks", default="all")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="first episode, of domain eval")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    seeds = range(options.seed, options.seed + options.episodes)
    for level in options.levels.split(","):
        tasks = tasks_of(level) if options.tasks == "all" else options.tasks.split(",")
        for task in tasks:
            for way in WAYS:
                policy, env = (
                    Guess(way, np.random.default_rng(options.seed)),
                    EnvConfig().make(task, level, domain="eval"),
                )
                solved = sum(play([env], [seed], policy)[0].success for seed in seeds)
                interval = list(wilson_interval(solved, len(seeds)))
                row = {"task": task, "level": level, "way": way, "episodes": len(seeds), "solved": solved}
                rows.append({**row, "interval": interval})
                print(f"{level} {task:<27}{way:<9}{100 * solved / len(seeds):5.1f}", flush=True)
        for way in WAYS:
            rates = [r["solved"] / r["episodes"] for r in rows if (r["level"], r["way"]) == (level, way)]
            print(f"{level} {'mean':<27}{way:<9}{100 * np.mean(rates):5.1f}", flush=True)
        if options.json:
            record = {**circumstances(), "episodes": options.episodes, "seed": options.seed, "rows": rows}
            options.json.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
