"""A demonstration: everything that one run of the oracle showed, did and led to."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from openvima import __version__
from openvima.data.columns import columns_of
from openvima.scene import (
    END_EFFECTORS,
    Action,
    EndEffector,
    ObjectRecord,
    Outcome,
    RenderedPrompt,
    Scene,
)

if TYPE_CHECKING:  # reading needs no simulation
    from openvima.env import TabletopEnv


@dataclass(frozen=True, slots=True, eq=False)
class Demonstration:
    """One rollout of the oracle over T steps, as stored.

    Args:
        task: Name of the task.
        level: "train", "L1", "L2", "L3" or "L4".
        domain: Domain of the seed.
        seed: The episode's number.
        num_redraws: Unlucky draws that the sampler threw away before this episode.
        max_steps: Steps that a policy is given for this episode.
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

    @property
    def num_steps(self) -> int:
        """Number of actions, T."""
        return len(self.actions)

    def observation(self, step: int) -> dict[str, object]:
        """Return what the environment showed before action `step` (or at the end, for `step` = T)."""
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
        return columns_of(self).content_hash


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What the oracle saw, and what it did then.

    Args:
        observation: As the environment gives it: "rgb" and "segm" of each view, and "ee".
        action: The action.
    """

    observation: dict[str, Any]  # Any: nested dictionaries
    action: Action


def rollout_oracle(env: "TabletopEnv", seed: int) -> Demonstration:
    """Let the oracle play one episode.

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
    episode, observations, scenes = env.episode, [observation], [env.scene]
    decisions, paths = [], []
    while not env.outcome.is_over and len(decisions) < episode.oracle_max_steps:
        decision = env.oracle_decision()
        observation, *_ = env.step(decision.action)
        decisions.append(decision)
        paths.append(env.joint_path)
        observations.append(observation)
        scenes.append(env.scene)
    return Demonstration(
        task=episode.task,
        level=episode.level,
        domain=episode.domain,
        seed=episode.seed,
        num_redraws=episode.num_redraws,
        max_steps=episode.max_steps,
        prompt=env.prompt,
        rgb=_stacked(observations, "rgb"),
        segm=_stacked(observations, "segm"),
        end_effector=scenes[0].end_effector,
        actions=tuple(decision.action for decision in decisions),
        pick_ids=tuple(decision.pick_id for decision in decisions),
        place_ids=tuple(decision.place_id for decision in decisions),
        joint_paths=tuple(paths),
        objects=tuple(ObjectRecord(p.id, p.object, p.texture) for p in scenes[0].placements),
        scenes=tuple(scenes),
        outcome=env.outcome,
        assets=env.assets.name,
        versions=package_versions(),
    )


def package_versions() -> dict[str, str]:
    """Return the versions of all packages that decide the bytes of a demonstration."""
    return dict(versions_of("mujoco", "numba", "numpy", "pyarrow"))


@lru_cache
def versions_of(*packages: str) -> Mapping[str, str]:
    """Return the versions of this package and of others, looked up once."""
    return MappingProxyType({"openvima": __version__, **{name: version(name) for name in packages}})


def _stacked(observations: list[dict], key: str) -> dict[str, np.ndarray]:
    return {view: np.stack([o[key][view] for o in observations]) for view in observations[0][key]}
