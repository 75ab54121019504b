"""A demonstration: observations, actions and outcome of one rollout; its columns, as shards store them."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import xxhash

from openvima.data.schema import IMAGE_SHAPE, VIEWS
from openvima.errors import brief_repr
from openvima.html import notebook_html
from openvima.imports import versions_of
from openvima.scene import (
    ACTION_SHAPES,
    END_EFFECTORS,
    Action,
    EndEffector,
    ObjectRecord,
    Outcome,
    RenderedPrompt,
    Scene,
)

_NUM_PIXELS = IMAGE_SHAPE[0] * IMAGE_SHAPE[1]

if TYPE_CHECKING:  # reading needs no simulation
    from openvima.env import TabletopEnv
    from openvima.env.config import EnvConfig

_JSON = json.JSONEncoder(sort_keys=True)


@dataclass(frozen=True, slots=True, eq=False)
class Demonstration:
    """One rollout of the oracle, or of a user, over T steps, as stored.

    Args:
        task: Name of the task.
        level: one of `openvima.catalog.LEVELS`.
        domain: Domain of the seed.
        seed: The episode's number.
        num_redraws: Rejected draws of the sampler before this episode.
        max_steps: Maximal number of steps of a policy.
        prompt: Text and images.
        rgb: View name to images, shape (T + 1, 3, 128, 256), uint8: before the first step and after each.
        segm: View name to object ids, shape (T + 1, 128, 256), uint8.
        end_effector: "suction" or "spatula".
        actions: The T actions.
        pick_ids: Id of the object that each action picks or sweeps.
        place_ids: Id of the object relative to which it is placed; -1 where it is tied
            to the table itself.
        joint_paths: Waypoints of the arm for each action, shape (W, 6), float32, radians.
        objects: All objects of the scene.
        scenes: Where they were, T + 1 scenes.
        outcome: How the episode ended.
        assets: Name of the asset pack.
        versions: Package name to version, of all packages that decide bytes.

    Demonstrations from elsewhere may lack what nobody recorded: `joint_paths` and `scenes` are then empty,
    and `pick_ids` and `place_ids` hold `schema.UNKNOWN_ID`.
    """

    task: str
    level: str
    domain: str
    seed: int
    num_redraws: int
    max_steps: int
    prompt: RenderedPrompt
    rgb: dict[str, np.ndarray]
    segm: dict[str, np.ndarray]
    end_effector: EndEffector
    actions: tuple[Action, ...]
    pick_ids: tuple[int, ...]
    place_ids: tuple[int, ...]
    joint_paths: tuple[np.ndarray, ...]
    objects: tuple[ObjectRecord, ...]
    scenes: tuple[Scene, ...]
    outcome: Outcome
    assets: str
    versions: dict[str, str]

    __repr__ = brief_repr

    def _repr_html_(self) -> str | None:
        return notebook_html("demonstration", demo=self)

    @property
    def num_steps(self) -> int:
        """Number of actions, T."""
        return len(self.actions)

    def observation(self, step: int) -> dict[str, object]:
        """Return the observation before action `step` (or the last one, for `step` = T)."""
        return {
            "rgb": {view: images[step] for view, images in self.rgb.items()},
            "segm": {view: images[step] for view, images in self.segm.items()},
            "ee": END_EFFECTORS.index(self.end_effector),
        }

    def content_hash(self) -> str:
        """Return 32 hexadecimal digits that are equal for equal content.

        Unlike the bytes of a file they depend neither on the version of pyarrow nor on compression. The
        versions of the packages do not count.
        """
        return make_columns(self)[0]["content_hash"]


@lru_cache(maxsize=4)
def make_env(
    task: str, level: str, domain: str, env_config: "EnvConfig", modalities: tuple[str, ...] = ("rgb", "segm")
) -> "TabletopEnv":
    """Make an environment once in this process, for all shards of a task."""
    env = env_config.make(task, level, domain=domain)
    env.modalities = modalities
    return env


def rollout_oracle(env: "TabletopEnv", seed: int) -> Demonstration:
    """Roll out the oracle for one episode.

    Args:
        env: The environment; it is reset.
        seed: The episode's number.

    Returns:
        The run, successful or not: it ends with success, failure, or after the oracle's number of steps.

    Raises:
        SamplingError: The task finds no start for this seed.
        OracleError: The oracle finds no action.
    """
    observation, _ = env.reset(seed=seed)
    rollout, decisions = Rollout(env, observation), []
    while not env.outcome.is_over and len(decisions) < env.episode.oracle_max_steps:
        decisions.append(env.oracle_decision())
        rollout.step(decisions[-1].action)
    return rollout.demonstration(
        [decision.pick_id for decision in decisions], [decision.place_id for decision in decisions]
    )


class Rollout:
    """Collects what a demonstration holds while an environment steps.

    Args:
        env: The environment, which was reset.
        observation: Its first observation.
    """

    def __init__(self, env: "TabletopEnv", observation: Mapping[str, Any]) -> None:
        self._env, self._observations, self._scenes = env, [observation], [env.scene]
        self._actions: list[Action] = []
        self._paths: list[np.ndarray] = []

    def step(self, action: Action) -> dict[str, Any]:
        """Execute an action and return the info of the environment."""
        observation, *_, info = self._env.perform(action)
        self._actions.append(action)
        self._paths.append(self._env.joint_path)
        self._observations.append(observation)
        self._scenes.append(self._env.scene)
        return info

    def demonstration(self, pick_ids: Sequence[int], place_ids: Sequence[int]) -> Demonstration:
        """Return the demonstration so far.

        Args:
            pick_ids: Id of the object that each action picks or sweeps.
            place_ids: Id of the object relative to which it is placed; see `Demonstration`.
        """
        env, episode = self._env, self._env.episode
        return Demonstration(
            task=episode.task,
            level=episode.level,
            domain=episode.domain,
            seed=episode.seed,
            num_redraws=episode.num_redraws,
            max_steps=episode.max_steps,
            prompt=env.prompt,
            rgb=_stack(self._observations, "rgb"),
            segm=_stack(self._observations, "segm"),
            end_effector=env.scene.end_effector,
            actions=tuple(self._actions),
            pick_ids=tuple(pick_ids),
            place_ids=tuple(place_ids),
            joint_paths=tuple(self._paths),
            objects=tuple(ObjectRecord(p.id, p.object, p.texture) for p in env.scene.placements),
            scenes=tuple(self._scenes),
            outcome=env.outcome,
            assets=env.assets.name,
            versions=package_versions(),
        )


def _stack(observations: Sequence[Mapping[str, Any]], key: str) -> dict[str, np.ndarray]:
    return {view: np.stack([o[key][view] for o in observations]) for view in observations[0][key]}


def package_versions() -> dict[str, str]:
    """Return the versions of all packages that decide the bytes of a demonstration."""
    return dict(versions_of("mujoco", "numba", "numpy", "pyarrow"))


def make_columns(demo: Demonstration) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return a demonstration column by column; only "skipped" is missing.

    Returns:
        Column name to what `to_pylist` gives of the column's row, for all that is no array, with the content
        hash that docs/format.md derives; and column name to array: poses (T + 1, objects, 7), the four arrays
        of the actions, the waypoints of all joint paths, one path after the other, and images, uint8,
        `prompt_rgb_…` and `rgb_…` (N, 128, 256, 3), `prompt_segm_…` and `segm_…` (N, 128, 256).
    """
    records, arrays = _records(demo), {}
    lengths = [len(path) for path in demo.joint_paths]
    described = {**records, "assets": demo.assets, "path_lengths": lengths}
    digest = xxhash.xxh3_128(_JSON.encode(described).encode())
    for name, array in _arrays(demo):
        digest.update(array.nbytes.to_bytes(8, "little"))
        digest.update(array.reshape(-1).view(np.uint8).data)  # while it is in the CPU cache
        arrays[name] = array
    return {**records, "content_hash": digest.hexdigest()}, arrays


def _records(demo: Demonstration) -> dict[str, Any]:
    return {
        "task": demo.task,
        "level": demo.level,
        "domain": demo.domain,
        "seed": demo.seed,
        "steps": demo.num_steps,
        "max_steps": demo.max_steps,
        "redraws": demo.num_redraws,
        "success": demo.outcome.success,
        "failure": demo.outcome.failure,
        "reason": demo.outcome.reason,
        "end_effector": demo.end_effector,
        "objects": _objects(demo),
        "pick_ids": list(demo.pick_ids),
        "place_ids": list(demo.place_ids),
        "prompt": demo.prompt.text,
        "prompt_images": [
            {"name": image.name, "kind": image.kind, "objects": [_record(shown) for shown in image.objects]}
            for image in demo.prompt.images.values()
        ],
    }


def _objects(demo: Demonstration) -> list[dict[str, object]]:
    records = [_record(record) for record in demo.objects]
    if not demo.scenes:
        unknown = [math.nan] * 3
        return [{**record, "size": unknown, "scale": unknown, "fixed": False} for record in records]
    return [
        {**record, "size": _floats(p.size), "scale": _floats(p.scale), "fixed": p.fixed}
        for record, p in zip(records, demo.scenes[0].placements, strict=True)
    ]


def _record(record: ObjectRecord) -> dict[str, object]:
    return {"id": record.object_id, "object": record.object, "texture": record.texture}


def _floats(values: Sequence[float]) -> list[float]:
    return [float(value) for value in values]  # as text, 1 and 1.0 would differ


def action_arrays(demo: Demonstration) -> dict[str, np.ndarray]:
    """Return the actions of a demonstration of T steps: name to numbers, shape (T, width), float32."""
    return {
        name: np.array([getattr(action, name) for action in demo.actions], "<f4").reshape(-1, width)
        for name, width in ACTION_SHAPES.items()
    }


def _arrays(demo: Demonstration) -> Iterator[tuple[str, np.ndarray]]:
    poses = [[(*p.pose.position, *p.pose.quaternion) for p in scene.placements] for scene in demo.scenes]
    yield "poses", np.array(poses, "<f8").reshape(len(poses), len(demo.objects), 7)
    yield from action_arrays(demo).items()
    paths = [np.zeros((0, 6), "<f4"), *demo.joint_paths]
    yield "joint_paths", np.concatenate(paths).astype("<f4", copy=False)
    shown = list(demo.prompt.images.values())
    for view in VIEWS:
        yield f"prompt_rgb_{view}", pixels([image.rgb[view] for image in shown])
    for view in VIEWS:
        segm = [image.segm[view] for image in shown]
        yield f"prompt_segm_{view}", np.stack(segm) if shown else np.empty((0, *IMAGE_SHAPE), np.uint8)
    for view in VIEWS:
        yield f"rgb_{view}", pixels(demo.rgb[view])
    for view in VIEWS:
        yield f"segm_{view}", np.ascontiguousarray(demo.segm[view])


def pixels(planes: np.ndarray | Sequence[np.ndarray]) -> np.ndarray:
    """Return images with their colours last.

    Args:
        planes: N images of shape (3, 128, 256), uint8.

    Returns:
        A copy of shape (N, 128, 256, 3), uint8, contiguous.
    """
    from openvima.data.kernels import join_colours  # Numba takes a moment to be imported

    memory = pa.allocate_buffer(3 * _NUM_PIXELS * len(planes))  # whose pages are used again
    joined = np.frombuffer(memory, np.uint8).reshape(-1, 3 * _NUM_PIXELS)
    for image, pixels in zip(planes, joined, strict=True):
        join_colours(np.ascontiguousarray(image).reshape(3, _NUM_PIXELS), pixels)
    return joined.reshape(-1, *IMAGE_SHAPE, 3)


def planes(pixels: np.ndarray) -> np.ndarray:
    """Return images with their colours first, as observations have them.

    Args:
        pixels: Shape (N, 128, 256, 3), uint8, contiguous.

    Returns:
        A copy of shape (N, 3, 128, 256), uint8, contiguous.
    """
    from openvima.data.kernels import part_colours

    parted = np.empty((len(pixels), 3, *IMAGE_SHAPE), np.uint8)
    part_colours(pixels.reshape(-1, 3 * _NUM_PIXELS), parted.reshape(-1, 3, _NUM_PIXELS))
    return parted
