"""Episodes as arguments of `compose`: to change one thing at a time."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any  # arguments of `compose`

import numpy as np
import yaml

from openvima.catalog import OBJECTS, object_spec
from openvima.catalog.geometry import Assets
from openvima.env.composing import SCALES, SceneObject, compose, default_names
from openvima.errors import SceneError
from openvima.scene import (
    AtPose,
    EndEffector,
    Episode,
    ObjectImage,
    PhotoImage,
    Placement,
    Pose,
    PromptFill,
    Scene,
)

_DECIMALS = 6  # of positions and angles that `compose` was given, which come back exactly


def _shown(fill: PromptFill, placements: Sequence[Placement]) -> int | None:
    """Id of the object of the scene that an image shows."""
    if not isinstance(fill, ObjectImage):
        return None
    key = fill.placement.id, fill.placement.object, fill.placement.texture
    return next((p.id for p in placements if (p.id, p.object, p.texture) == key), None)


def _image(fill: PromptFill) -> Any:
    if isinstance(fill, ObjectImage):
        return fill.placement.object, fill.placement.texture
    return fill if isinstance(fill, PhotoImage) else [_object(p) for p in fill.scene.placements]


def _object(placement: Placement, name: str = "") -> SceneObject:
    """An object as `compose` takes it."""
    pose = placement.pose
    position = round(pose.x, _DECIMALS), round(pose.y, _DECIMALS)
    yaw_deg = round(math.degrees(pose.yaw_rad), _DECIMALS)
    sizes = zip(placement.size, placement.scale, object_spec(placement.object).size_max, strict=True)
    factors = [size * scale / largest for size, scale, largest in sizes if largest]  # some are flat
    scale = round(min(max(sum(factors) / len(factors), SCALES[0]), SCALES[1]), 3)
    return SceneObject(placement.object, placement.texture, position, yaw_deg, name, scale, placement.fixed)


def _goal(goal: object, scene: Scene, handles: Mapping[int, str], number: int) -> tuple[Any, ...]:
    """A goal by name."""
    object_id, relative_to = getattr(goal, "object_id", None), getattr(goal, "relative_to", None)
    if object_id is None or object_id not in handles or not hasattr(goal, "relative_to"):
        raise SceneError(f"goal {number} is a {type(goal).__name__}, which has no composed form.")
    if not isinstance(goal, AtPose):
        if relative_to is None:
            raise SceneError(f"goal {number} has a zone that is no object's, which has no composed form.")
        return "swept_into", handles[object_id], handles[relative_to]
    if relative_to == object_id:
        turn_deg = math.degrees(scene[object_id].pose.yaw_rad - goal.target.yaw_rad)
        return "rotated", handles[object_id], round(math.remainder(turn_deg, 360), _DECIMALS)
    if relative_to is not None:
        return "in", handles[object_id], handles[relative_to]
    position = round(goal.target.x, _DECIMALS), round(goal.target.y, _DECIMALS)
    is_turned = goal.tolerance.yaw_rad is not None
    heading = (round(math.degrees(goal.target.yaw_rad), _DECIMALS),) if is_turned else ()
    return "at", handles[object_id], position, *heading


# Positions that are tried for a new object, nearest to the middle of the table first.
_GRID = itertools.product((0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65), (y / 20 for y in range(-8, 9)))
_POSITIONS = sorted(_GRID, key=lambda place: math.dist(place, (0.5, 0.0)))
_SHELF_X_M, _SHELF_STEP_M, _SHELF_OBJECT_M, _SHELF_COLUMNS = 0.82, 0.066, 0.055, 16
_ROUND_M, _ROUND_DEG = 3, 1  # decimals of positions and headings


@dataclass(frozen=True, slots=True)
class Composition:
    """The arguments of `compose`, to be changed one at a time.

    Args:
        objects: The objects, each with its handle as `name`: the first placeholder that shows it, or
            a letter.
        prompt: The text.
        images: Content of placeholders that are not handles, as for `compose`.
        goals: Goals by name, as for `compose`.
        max_steps: Step limit; None for that of `compose`.
        end_effector: "suction" or "spatula".
        level: Level of the episode that it came from: what is held out stays so, however it is edited.
        domain: Domain of the seed of that episode.

    Example:
        >>> scene = Composition.of(compose([("heart", "red", (0.5, 0.1))], "Turn the {a}."))
        >>> scene.moved("a", (0.4, 0.0), 30).objects[0].position
        (0.4, 0.0)
    """

    objects: tuple[SceneObject, ...]
    prompt: str
    images: dict[str, Any] = field(default_factory=dict)
    goals: tuple[Any, ...] = ()
    max_steps: int | None = None
    end_effector: EndEffector = "suction"
    level: str = "train"
    domain: str = "user"

    @staticmethod
    def of(episode: Episode) -> "Composition":
        """Return the composition of a composed or sampled episode.

        Composed episodes come back exactly, but for handles that the prompt does not show, and photos, which
        stay `PhotoImage`. Of sampled ones the objects come back at their positions with the proportions of
        the catalogue, and the goals; constraints and stages have no composed form and are left out.

        Raises:
            SceneError: A goal has no composed form.
        """
        problem = episode.problem
        placements, fills = problem.scene.placements, problem.prompt.images
        shown = {slot: _shown(fill, placements) for slot, fill in fills}
        first = {shown[slot]: slot for slot in reversed(shown)}
        free = (name for name in default_names() if name not in shown)
        handles = {p.id: first.get(p.id) or next(free) for p in placements}
        images = {}
        for slot, fill in fills:
            if (object_id := shown[slot]) is None:
                images[slot] = _image(fill)
            elif handles[object_id] != slot:
                images[slot] = handles[object_id]
        return Composition(
            tuple(_object(p, handles[p.id]) for p in placements),
            problem.prompt.text,
            images,
            tuple(_goal(goal, problem.scene, handles, number) for number, goal in enumerate(problem.goals)),
            episode.max_steps,
            problem.scene.end_effector,
            episode.level,
            episode.domain,
        )

    def episode(self, assets: Assets) -> Episode:
        """Compose the episode.

        Raises:
            SceneError, UnknownNameError: As for `compose`.
        """
        composed = compose(
            list(self.objects),
            self.prompt,
            images=self.images,
            goals=self.goals,
            max_steps=self.max_steps,
            end_effector=self.end_effector,
            assets=assets,
        )
        return replace(composed, level=self.level, domain=self.domain)

    def __getitem__(self, handle: str) -> SceneObject:
        for each in self.objects:
            if each.name == handle:
                return each
        names = ", ".join(each.name for each in self.objects)
        raise SceneError(f"there is no object {handle!r:.80}; the scene has {names}.")

    def added(
        self,
        object_name: str,
        texture: str,
        assets: Assets,
        *,
        position: tuple[float, float] | None = None,
    ) -> "Composition":
        """Add an object under the next free letter.

        Args:
            object_name: Display name.
            texture: Display name.
            assets: Asset pack.
            position: x, y in metres, rounded to millimetres; None: the free one nearest to the middle.

        Raises:
            SceneError: The position is not free, or none is.
            UnknownNameError: The catalogue has no such object or texture.
        """
        taken = {each.name for each in self.objects} | {*self.images}
        name = next(each for each in default_names() if each not in taken)
        reason = SceneError("there is no room on the table.")
        for place in _POSITIONS if position is None else [_rounded(position)]:
            new = replace(self, objects=(*self.objects, SceneObject(object_name, texture, place, name=name)))
            try:
                replace(new, prompt="-", images={}, goals=()).episode(assets)
            except SceneError as error:
                reason = error
                continue
            return new
        raise SceneError(f"there is no room for a {texture} {object_name}: {reason}")

    def moved(self, handle: str, position: tuple[float, float], yaw_deg: float) -> "Composition":
        """Move an object to a position and heading, rounded to millimetres and tenths of a degree."""
        return self.changed(handle, position=_rounded(position), yaw_deg=round(float(yaw_deg), _ROUND_DEG))

    def changed(self, handle: str, **fields: Any) -> "Composition":
        """Change fields of an object.

        Raises:
            SceneError: There is no such object.
        """
        new = replace(self[handle], **fields)
        return replace(self, objects=tuple(new if each.name == handle else each for each in self.objects))

    def removed(self, handle: str) -> "Composition":
        """Take an object away."""
        gone = self[handle]
        return replace(self, objects=tuple(each for each in self.objects if each is not gone))

    def scene_image(self) -> list[tuple[str, str, tuple[float, float], float]]:
        """Return the present arrangement in the form of a prompt image of a whole scene."""
        return [(each.object, each.texture, each.position, each.yaw_deg) for each in self.objects]

    @property
    def goals_text(self) -> str:
        """The goals in one line of YAML, such as "[in, a, b], [rotated, a, 60]"."""
        listed = [[[*part] if isinstance(part, tuple) else part for part in goal] for goal in self.goals]
        text = yaml.safe_dump(listed, default_flow_style=True, width=10**6, allow_unicode=True)
        return text.strip()[1:-1]


def parse_goals(text: str) -> tuple[Any, ...]:
    """Read goals as `Composition.goals_text` writes them.

    Raises:
        SceneError: It is no list of lists.
    """
    try:
        listed = yaml.safe_load(f"[{text}]")
    except (yaml.YAMLError, ValueError):
        listed = None
    if not isinstance(listed, list) or not all(isinstance(goal, list) for goal in listed):
        raise SceneError(f"the goals are {text!r:.80}; write them as [in, a, b], [rotated, a, 60].")
    return tuple(tuple(goal) for goal in listed)


def shelf(texture: str, assets: Assets) -> list[Placement]:
    """Return all objects of the catalogue in one texture, equally large, in rows before the table.

    Args:
        texture: Display name.
        assets: Asset pack.
    """
    placements = []
    for number, (name, spec) in enumerate(OBJECTS.items()):
        row, column = divmod(number, _SHELF_COLUMNS)
        y = _SHELF_STEP_M * (column - (_SHELF_COLUMNS - 1) / 2)
        corners = assets.geometry(name, spec.size_max).visual.vertices.reshape(-1, 3)
        factor = _SHELF_OBJECT_M / float(np.ptp(corners[:, :2], axis=0).max())
        scale = (factor, factor, factor)
        height_m = assets.geometry(name, spec.size_max, scale).rest_z_m
        pose = Pose.planar(_SHELF_X_M + _SHELF_STEP_M * row, y, z=height_m)
        placements.append(Placement(number, name, texture, spec.size_max, pose, scale=scale))
    return placements


def _rounded(position: tuple[float, float]) -> tuple[float, float]:
    x, y = (round(float(value), _ROUND_M) for value in position)
    return x, y
