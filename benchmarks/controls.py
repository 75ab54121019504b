r"""What guesses solve at a level: controls that read no prompt, or no words of it.

    openvima evaluate --policy guess=benchmarks/controls.py:guess,first=benchmarks/controls.py:first,\
        similar=benchmarks/controls.py:similar --levels L5,L6,L7,L8 --episodes 100 --out guesses

guess    Any object that can be moved goes to any that cannot, without rotation; where there is none, to any
         place on the table. Reads no prompt.
first    The same, objects by ascending id: what order and ids give away.
similar  The objects that look most like the images of the prompt, in their order, go to the fixed ones that
         look most like its images; of a scene image, to their places in the last one. Reads no words, and
         compares true shapes and textures, so it mistakes none.

Each goes on until the episode ends. They read the environments, which no policy may.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.env import TabletopEnv
from openvima.errors import OracleError
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Action, ObjectImage, Placement, SceneImage
from openvima.tasks.oracle import visible_point

Point = tuple[float, float]


class Guess:
    """Moves objects in one way; what is not decided is drawn from the number of the episode."""

    modalities = ("joints",)  # nothing is rendered

    def __init__(self, way: Literal["guess", "first", "similar"]) -> None:
        self._way = way
        self._envs: list[tuple[TabletopEnv, np.random.Generator]] = []
        self._step = -1

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start a batch of episodes."""
        self._envs, self._step = [(env, np.random.default_rng(env.episode.seed)) for env in envs], -1

    def decide(self, observations: Sequence[Mapping | None]) -> list[Action | None]:
        """Move one object in each environment that runs."""
        self._step += 1
        pairs = zip(self._envs, observations, strict=True)
        return [None if seen is None else self._move(*episode) for episode, seen in pairs]

    def _move(self, env: TabletopEnv, rng: np.random.Generator) -> Action:
        loose = [p for p in env.scene.placements if not p.fixed]
        fixed = [p for p in env.scene.placements if p.fixed]
        x, y = rng.uniform(WORKSPACE_LOW, WORKSPACE_HIGH).tolist()
        if self._way == "similar":
            picked, place = self._by_images(env, loose, fixed) or (loose[0], (x, y))
        elif self._way == "first":
            picked = loose[self._step % len(loose)]
            place = (fixed[0].pose.x, fixed[0].pose.y) if fixed else (x, y)
        else:
            picked = loose[int(rng.integers(len(loose)))]
            base = fixed[int(rng.integers(len(fixed)))] if fixed else None
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


def guess() -> Guess:
    """Make the control that draws objects and places."""
    return Guess("guess")


def first() -> Guess:
    """Make the control that takes objects by their ids."""
    return Guess("first")


def similar() -> Guess:
    """Make the control that goes by looks."""
    return Guess("similar")
