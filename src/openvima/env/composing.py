"""Composed episodes: scenes, prompts and goals of users."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any  # of whatever type a user gives; checked here

import numpy as np

from openvima.catalog import Assets, Pool, load_assets
from openvima.env.checked_values import shown
from openvima.env.composed_goals import composed_goals
from openvima.env.composed_objects import ObjectLike, add_object, scene_objects
from openvima.env.composed_prompt import ImageMaker, composed_prompt
from openvima.env.photos import read_photo
from openvima.errors import SceneError, unknown_name
from openvima.scene import COMPOSED, END_EFFECTORS, EndEffector, Episode, PhotoImage, Placement, Problem
from openvima.tasks.table import TableSampler

COMPOSE_KEYS = ("objects", "prompt", "images", "goals", "max_steps", "end_effector")
DEFAULT_MAX_STEPS, MAX_STEPS_WITHOUT_GOALS = 10, 3
MAX_STEPS = 1000
_POOL = Pool((), (), (), ())


def compose(
    objects: Mapping[str, ObjectLike] | Sequence[ObjectLike],
    prompt: str,
    *,
    images: Mapping[str, Any] | None = None,
    goals: Sequence[Any] = (),
    max_steps: int | None = None,
    end_effector: str = "suction",
    assets: str | Path | Assets = "procedural",
) -> Episode:
    """Compose an episode from a scene and a prompt of one's own.

    Args:
        objects: The objects, each `(object, texture, (x, y))`, with the heading in degrees as an optional
            fourth entry, or a `SceneObject`, or a mapping of its fields. In a mapping, the keys are their
            handles; in a list, the handles are "a", "b", … unless an object has a name.
        prompt: The text with a `{placeholder}` for each image.
        images: Content of placeholders that are not handles: a handle or an index into the objects;
            `(object, texture)` of the catalogue; the path of a PNG file with an object on white; or a list of
            objects for an image of a whole scene, each as in `objects` or `(handle, (x, y))` for an object of
            the scene somewhere else.
        goals: Goals in the order of the oracle: `("in", a, b)`, which holds on b too, `("at", a, (x, y))`,
            `("rotated", a, degrees)` clockwise, `("swept_into", a, b)`; or goals of `openvima.scene`. Without
            goals the episode ends at the step limit only.
        max_steps: Step limit, 1 … 1000; by default 10, and 3 without goals.
        end_effector: "suction", or "spatula" for sweeps.
        assets: Asset pack.

    Returns:
        The episode.

    Raises:
        SceneError: An object is malformed, outside the workspace or overlaps another; the prompt, an image
            or a goal is malformed. The message names the object and the limit.
        UnknownObjectError, UnknownTextureError: The catalogue has no such object or texture.
        InputFileError: A PNG file cannot be used.

    Example:
        >>> objects = [("heart", "red swirl", (0.5, -0.2)), ("bowl", "green", (0.5, 0.2))]
        >>> compose(objects, "Put the {a} into the {b}.").problem.prompt.text
        'Put the {a} into the {b}.'
    """
    return composed(
        {"objects": objects, "prompt": prompt, "images": images, "goals": goals, "max_steps": max_steps}
        | {"end_effector": end_effector},
        assets=load_assets(assets),
        photo=lambda path: read_photo(Path(path)),
    )


def composed(values: Mapping[str, Any], *, assets: Assets, photo: Callable[[str], PhotoImage]) -> Episode:
    """Compose an episode from the arguments of `compose`, as a file holds them.

    Args:
        values: The arguments; any plain values.
        assets: Asset pack.
        photo: Reads a PNG file.

    Raises:
        SceneError, UnknownObjectError, UnknownTextureError, InputFileError: As for `compose`.
    """
    if unknown := [key for key in values if key not in COMPOSE_KEYS]:
        raise SceneError(unknown_name("key of a scene:", unknown[0], COMPOSE_KEYS))
    end_effector = _end_effector(values.get("end_effector", "suction"))
    max_steps = values.get("max_steps")
    if max_steps is None:
        max_steps = DEFAULT_MAX_STEPS if values.get("goals") else MAX_STEPS_WITHOUT_GOALS
    if type(max_steps) is not int or not 1 <= max_steps <= MAX_STEPS:
        raise SceneError(f"max_steps is {shown(max_steps)}; give a whole number from 1 to {MAX_STEPS}.")
    table = TableSampler(np.random.default_rng(0), _POOL, assets=assets, end_effector=end_effector)
    handles: dict[str, Placement] = {}
    for given in scene_objects(values.get("objects")):
        handles[given.name] = add_object(table, given, handles)
    scene = table.scene()
    fills = ImageMaker(handles, table, photo)
    problem = Problem(
        scene,
        composed_prompt(values.get("prompt"), values.get("images"), fills),
        composed_goals(values.get("goals"), handles, end_effector, assets),
    )
    return Episode(COMPOSED, "train", "user", 0, problem, oracle_max_steps=max_steps, max_steps=max_steps)


def _end_effector(given: object) -> EndEffector:
    for known in END_EFFECTORS:
        if given == known:
            return known
    raise SceneError(f"end_effector is {shown(given)}; allowed are {' and '.join(END_EFFECTORS)}.")
