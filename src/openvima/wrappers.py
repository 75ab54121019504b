"""Wrappers for libraries of reinforcement learning: vectors as observations and actions, dense rewards."""

import math
import re
import zlib
from collections.abc import Mapping, Sequence
from typing import Any  # observations and infos are nested dictionaries

import gymnasium
import numpy as np
from gymnasium import spaces

from openvima.errors import ActionError, ConfigError, echo
from openvima.perception.objects import TOP, ObjectViews, observe, observe_prompt_image
from openvima.render.camera import CAMERAS
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Action, PromptImage
from openvima.scene.action import END_EFFECTOR, HIGHEST_TIP_Z_M
from openvima.scene.goal import object_of
from openvima.tasks.goals import LEVER_M

ACTION_SIZE = 6
PATCHES = 4  # rows and columns of patches that a crop is averaged over
OBJECT_SIZE = 8 + 3 * PATCHES**2
TOOL_SIZE = 6
NUM_BUCKETS = 64  # of words

_LOW, _HIGH = np.array(WORKSPACE_LOW), np.array(WORKSPACE_HIGH)


class FlatAction(gymnasium.ActionWrapper):
    """Takes actions from a box: shape (6,), float32, each −1 … 1.

    | numbers | meaning |
    |---|---|
    | 0, 1 | x, y where to pick or to start sweeping; −1 and 1 are the bounds of actions |
    | 2, 3 | x, y where to place or to end |
    | 4, 5 | sine and cosine of the rotation, counter-clockwise from above, of any length; zeros: none |

    Args:
        env: An environment of the package, wrapped or not, with control "primitives".

    Raises:
        ConfigError: The control is another.

    Example:
        >>> env = FlatAction(openvima.make("rotate"))  # doctest: +SKIP
        >>> env.step(FlatAction.flatten(env.unwrapped.oracle_decision().action))  # doctest: +SKIP
    """

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        base: Any = env.unwrapped
        if base.control == END_EFFECTOR:
            raise ConfigError(
                f"control is {END_EFFECTOR!r}, whose actions are a box already; FlatAction takes control "
                "'primitives'. gymnasium.wrappers.RescaleAction(env, -1, 1) scales the box."
            )
        self.action_space = spaces.Box(-1, 1, (ACTION_SIZE,), np.float32)

    def action(self, action: Any) -> dict[str, np.ndarray]:
        """Return the action of the environment.

        Args:
            action: Shape (6,), any floating-point dtype.

        Raises:
            ActionError: The shape is another, or a value is not in −1 … 1. Nothing was moved.
        """
        values = np.asarray(action)
        fits = values.shape == (ACTION_SIZE,) and values.dtype.kind == "f"
        if not fits or not (np.abs(values) <= 1).all():  # also without NaN
            raise ActionError(
                f"the action is {echo(repr(action))}; it must be an array of {ACTION_SIZE} floating-point "
                "numbers, each in -1 … 1. Nothing was moved."
            )
        pick, place = _LOW + (values.reshape(3, 2)[:2].astype(np.float64) + 1) / 2 * (_HIGH - _LOW)
        return Action.planar(tuple(pick), tuple(place), float(np.arctan2(*values[4:]))).to_arrays()

    @staticmethod
    def flatten(action: Action | Mapping[str, Any]) -> np.ndarray:
        """Return an action of an environment or of the oracle as six numbers, float32.

        Raises:
            ActionError: The action is invalid.
        """
        checked = action if isinstance(action, Action) else Action.from_arrays(action)
        points = np.array([checked.pose0_position, checked.pose1_position])
        scaled = np.clip(_scaled(points), -1, 1)  # float32 rounds beyond the bounds
        angle_rad = checked.yaw1_rad - checked.yaw0_rad
        return np.array([*scaled.flat, np.sin(angle_rad), np.cos(angle_rad)], np.float32)


class _PromptedObservation(gymnasium.ObservationWrapper):
    """Encodes a prompt once an episode, and its words anew with the end effector and the tool."""

    _words: np.ndarray  # of `_prompt`, as its images
    _images: np.ndarray

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self._base: Any = env.unwrapped  # a TabletopEnv, which importing would load MuJoCo for
        self._num_words = NUM_BUCKETS + 1 + TOOL_SIZE * (self._base.control == END_EFFECTOR)
        self._prompt = None

    def _encode_words(self, observation: Mapping[str, Any]) -> np.ndarray:
        """Return words, end effector and tool, and keep the images of the prompt of a new episode."""
        prompt = self._base.prompt
        if self._prompt is not prompt:
            parts = prompt.sequence()
            self._images = self._encode_images([part for part in parts if not isinstance(part, str)])
            self._prompt, self._words = prompt, _words(parts)
        tool = ()
        if "tool" in observation:
            x, y, z, yaw_rad, holds = observation["tool"]
            height, (x, y) = 2 * z / HIGHEST_TIP_Z_M - 1, _scaled(np.array([x, y]))
            tool = np.clip([x, y, height, np.sin(yaw_rad), np.cos(yaw_rad), holds], -1, 1)
        return np.concatenate([self._words, [observation["ee"]], tool], dtype=np.float32)

    def _encode_images(self, images: list[PromptImage]) -> np.ndarray:
        raise NotImplementedError


class FlatObservation(_PromptedObservation):
    """Gives observations as one vector: float32, each value −1 … 1.

    It holds what policies over objects see, no state of the simulator: `max_objects` rows for objects on the
    table, from left to right, `max_prompt_objects` rows for objects in the prompt's images, in reading order,
    64 numbers for the words of the prompt, and the end effector; with control "end_effector" 6 numbers for
    the tool too. `rows` splits a vector.

    | numbers of a row | meaning |
    |---|---|
    | 0 | 1: there is an object; else the row is zero |
    | 1, 2 | x, y on the table; −1 and 1 are the bounds of actions. Of the prompt's object images: 0 |
    | 3, 4 | height and width of its box in the top view, as fractions of the image's |
    | 5 | of the prompt's objects: index of the image, divided by `max_prompt_objects` |
    | 6, 7 | x, y of its most interior pixel, where it can be picked, scaled as 1, 2 |
    | 8 … 55 | colours of its crop in the top view, averaged over 4 × 4 patches |

    A word sets one of the 64 numbers, chosen by its CRC-32, to 1. The end effector is 0 (suction cup) or 1.
    The tool's numbers are x, y, scaled as those of objects and clipped, its height, −1 at the table and 1 at
    0.35 m, sine and cosine of its yaw, and 1 while it holds.

    Args:
        env: An environment of the package, wrapped or not, that observes `rgb` and `segm`.
        max_objects: Rows for objects on the table; no task has more than 18 by default.
        max_prompt_objects: Rows for objects in the prompt's images; likewise.
    """

    def __init__(self, env: gymnasium.Env, *, max_objects: int = 18, max_prompt_objects: int = 18) -> None:
        super().__init__(env)
        self.max_objects, self.max_prompt_objects = max_objects, max_prompt_objects
        size = (max_objects + max_prompt_objects) * OBJECT_SIZE + self._num_words
        self.observation_space = spaces.Box(-1, 1, (size,), np.float32)

    def observation(self, observation: Mapping[str, Any]) -> np.ndarray:
        """Return an observation of the running episode as a vector.

        Raises:
            ConfigError: There are more objects than rows.
        """
        words = self._encode_words(observation)
        objects = self._rows([(observe(observation), True)], "max_objects")
        return np.concatenate([objects.ravel(), self._images.ravel(), words])

    def rows(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split vectors into objects, objects of the prompt, and words with the end effector and the tool.

        Args:
            observation: Shape (..., size).

        Returns:
            Shapes (..., max_objects, 56), (..., max_prompt_objects, 56) and (..., 65), with control
            "end_effector" (..., 71).
        """
        ends = np.cumsum([self.max_objects, self.max_prompt_objects]) * OBJECT_SIZE
        objects, prompt, words = np.split(observation, ends, axis=-1)
        shape = (*observation.shape[:-1], -1, OBJECT_SIZE)
        return objects.reshape(shape), prompt.reshape(shape), words

    def _encode_images(self, images: list[PromptImage]) -> np.ndarray:
        seen = [(observe_prompt_image(image), image.kind == "scene") for image in images]
        return self._rows(seen, "max_prompt_objects")

    def _rows(self, images: list[tuple[ObjectViews, bool]], limit: str) -> np.ndarray:
        """One row for each object of images, shape (limit, 56), with its position if it is on the table."""
        num_rows = getattr(self, limit)
        num_objects = sum(len(objects) for objects, _ in images)
        if num_objects > num_rows:
            raise ConfigError(f"{limit} is {num_rows}, but there are {num_objects} objects; give more rows.")
        rows = np.zeros((num_rows, OBJECT_SIZE), np.float32)
        start = 0
        for index, (objects, is_on_table) in enumerate(images):
            filled = rows[start : start + len(objects)]
            filled[:, 0] = 1
            if is_on_table:
                filled[:, 1:3] = np.clip(_scaled(objects.positions()), -1, 1)
                filled[:, 6:8] = np.clip(_scaled(objects.grasp_points()), -1, 1)
            filled[:, 3:5] = objects.boxes[TOP][:, 2:] / (CAMERAS["top"].height, CAMERAS["top"].width)
            filled[:, 5] = index / num_rows
            # Crops, (N, 3, 32, 32), averaged over patches.
            crops, side = objects.crops[TOP], objects.crops.shape[-1] // PATCHES
            tiles = crops.reshape(len(crops), 3, PATCHES, side, PATCHES, side)
            filled[:, 8:] = tiles.mean(axis=(3, 5)).reshape(len(crops), -1) / 255
            start += len(objects)
        return rows


class ImageObservation(_PromptedObservation):
    """Gives observations as a flat dictionary of images and words, such as SB3's `MultiInputPolicy` takes.

    | key | value |
    |---|---|
    | `front`, `top` | uint8, shape (3, 64, 128): averaged over squares of 2 × 2 pixels |
    | `prompt` | top views of the prompt's images in reading order, one below the other in channels: uint8, \
shape (3 × max_prompt_images, 64, 128), zeros where there is none |
    | `words` | words of the prompt and end effector, with control "end_effector" also the tool, as in \
`FlatObservation`: float32, shape (65,) or (71,), −1 … 1 |

    Args:
        env: An environment of the package, wrapped or not, that observes `rgb`.
        max_prompt_images: Images of a prompt at most.

    Raises:
        ConfigError: The environment does not observe `rgb`.
    """

    def __init__(self, env: gymnasium.Env, *, max_prompt_images: int = 4) -> None:
        super().__init__(env)
        if "rgb" not in self._base.modalities:
            raise ConfigError(f"modalities are {self._base.modalities}; ImageObservation needs rgb.")
        self.max_prompt_images = max_prompt_images
        shape = CAMERAS["top"].height // 2, CAMERAS["top"].width // 2
        images = {**dict.fromkeys(CAMERAS, 3), "prompt": 3 * max_prompt_images}
        parts: dict[str, spaces.Space] = {
            name: spaces.Box(0, 255, (channels, *shape), np.uint8) for name, channels in images.items()
        }
        parts["words"] = spaces.Box(-1, 1, (self._num_words,), np.float32)
        self.observation_space = spaces.Dict(parts)

    def observation(self, observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return an observation of the running episode as a flat dictionary.

        Raises:
            ConfigError: The prompt has more than `max_prompt_images` images.
        """
        words = self._encode_words(observation)
        images = {view: _shrunk(image) for view, image in observation["rgb"].items()}
        return {**images, "prompt": self._images.copy(), "words": words}

    def _encode_images(self, images: list[PromptImage]) -> np.ndarray:
        if len(images) > self.max_prompt_images:
            raise ConfigError(
                f"max_prompt_images is {self.max_prompt_images}, but the prompt has {len(images)}; give more."
            )
        encoded = np.zeros(self.observation_space["prompt"].shape, np.uint8)  # type: ignore[index]
        for index, image in enumerate(images):
            encoded[3 * index : 3 * index + 3] = _shrunk(image.rgb["top"])
        return encoded


class ProgressReward(gymnasium.Wrapper):
    """Adds dense rewards, by the progress that a step makes.

    The reward of a step is 1 for success plus the difference of a potential before and after it, so that the
    best policy stays the same (Ng, Harada and Russell, 1999, without discount). The potential is `goals_met`
    minus `distance_m` minus 0.1 × `angle_rad` of `info["progress"]`.

    Few random actions move anything, so this is 0 nearly always at first. With `reach_weight` the reward also
    sees the reach: the planar distance in metres from where an action picks or begins to sweep to the nearest
    object of the goals that can be met next. With control "primitives" it is subtracted at every step, which
    favours short episodes; with "end_effector" it is the distance of the tool, and part of the potential.

    Args:
        env: An environment of the package, wrapped or not.
        reach_weight: Factor of the reach.
    """

    def __init__(self, env: gymnasium.Env, *, reach_weight: float = 0.0) -> None:
        super().__init__(env)
        self.reach_weight = reach_weight
        self._base: Any = env.unwrapped  # a TabletopEnv, as above
        self._potential = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Start an episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._potential = self._potential_of(info)
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        """Take a step."""
        cost = 0.0
        if self.reach_weight and self._base.control != END_EFFECTOR:
            cost = self.reach_weight * self._reach(self._pick(action))
        observation, reward, terminated, truncated, info = self.env.step(action)
        before, self._potential = self._potential, self._potential_of(info)
        return observation, float(reward) + self._potential - before - cost, terminated, truncated, info

    def _potential_of(self, info: Mapping[str, Any]) -> float:
        progress = info["progress"]
        distance = progress["distance_m"] + LEVER_M * progress["angle_rad"]
        potential = progress["goals_met"] - (distance if np.isfinite(distance) else 0.0)
        if self.reach_weight and self._base.control == END_EFFECTOR:
            potential -= self.reach_weight * self._reach(self._base.tool[:2])
        return potential

    def _pick(self, action: Any) -> tuple[float, ...]:
        """Return x, y where an action of this wrapper picks, in metres."""
        env = self.env
        while env is not env.unwrapped:
            wrapper: Any = env
            if isinstance(wrapper, gymnasium.ActionWrapper):
                action = wrapper.action(action)
            env = wrapper.env
        return (action if isinstance(action, Action) else Action.from_arrays(action)).pose0_position

    def _reach(self, point: Sequence[float]) -> float:
        """Return the distance of a point from the nearest object of the goals that can be met next."""
        problem, open_goals = self._base.episode.problem, self._base.progress.open_goals
        stage = problem.stage_of(open_goals[0]) if open_goals else ()
        ids = {object_of(problem.goals[index]) for index in open_goals if index in stage} - {None}
        poses = [self._base.scene[object_id].pose for object_id in ids]
        return min((math.hypot(pose.x - point[0], pose.y - point[1]) for pose in poses), default=0.0)


def _scaled(points: np.ndarray) -> np.ndarray:
    return (points - _LOW) / (_HIGH - _LOW) * 2 - 1


def _words(parts: Sequence[object]) -> np.ndarray:
    """Encode the words of a prompt, shape (64,), float32."""
    words = np.zeros(NUM_BUCKETS, np.float32)
    for word in re.findall(r"\w+", " ".join(part for part in parts if isinstance(part, str)).lower()):
        words[zlib.crc32(word.encode()) % NUM_BUCKETS] = 1
    return words


def _shrunk(image: np.ndarray) -> np.ndarray:
    """Average an image over squares: shape (3, H, W) to (3, H / 2, W / 2), uint8."""
    channels, height, width = image.shape
    tiles = image.reshape(channels, height // 2, 2, width // 2, 2)
    return tiles.mean(axis=(2, 4)).astype(np.uint8)
