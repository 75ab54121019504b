"""Replaying stored episodes: seed, oracle and actions must reproduce the same bytes.

Demonstrations of users are compared without the oracle. Of composed scenes goals and prompt are not stored:
these begin with the stored scene, and prompt and outcome are not compared.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from openvima.data.encoding import ShardInfo
from openvima.data.records import Demonstration
from openvima.data.shard import Shard
from openvima.env.config import EnvConfig
from openvima.errors import (
    AssetError,
    OpenVimaError,
)
from openvima.scene import COMPOSED, HOST_TASK, Episode, RenderedPrompt

if TYPE_CHECKING:  # comes with the simulator
    from openvima.env import TabletopEnv


@dataclass(frozen=True, slots=True)
class ReplayTask:
    """Episodes of one shard to replay.

    Args:
        path: The file.
        info: Its metadata.
        rows: Its records to replay.
        assets: Name or folder of the asset pack.
    """

    path: Path
    info: ShardInfo
    rows: tuple[int, ...]
    assets: str


def replay_shard(task: ReplayTask, count: Callable[[int], None]) -> list[tuple[int, str]] | str:
    """Replay episodes of a shard.

    Args:
        task: The episodes.
        count: Called with the number of episodes replayed so far.

    Returns:
        Row and first difference of those that differ; or why none can be replayed.
    """
    shard, info, found = Shard(task.path), task.info, []
    try:
        env = _make_env(info.task, info.level, info.domain, replace(info.env_config, assets=task.assets))
    except OpenVimaError as error:  # the task is not installed, or the asset pack not imported
        return str(error)
    for number, row in enumerate(task.rows, start=1):
        try:
            difference = find_difference(env, shard[row])
        except AssetError as error:
            return str(error)
        except OpenVimaError as error:
            difference = f"it stops: {error}"
        if difference:
            found.append((row, difference))
        count(number)
    return found


def find_difference(env: "TabletopEnv", demo: Demonstration) -> str:
    """Replay a demonstration and compare prompt, scenes, images, actions and joint paths bit by bit.

    Args:
        env: An environment of the same task, level and settings.
        demo: The demonstration.

    Returns:
        The first difference; empty if there is none.

    Raises:
        SamplingError: The task no longer samples an episode for the seed.
        OracleError: The oracle no longer finds an action.
    """
    is_composed = demo.task == COMPOSED
    if is_composed:
        episode = Episode.of_scene(demo.scenes[0], seed=demo.seed, max_steps=demo.max_steps)
        observation, _ = env.reset(options={"episode": episode})
    else:
        observation, _ = env.reset(seed=demo.seed)
        if (env.episode.num_redraws, env.episode.max_steps) != (demo.num_redraws, demo.max_steps):
            return "the seed gives another episode"
        if not _is_same_prompt(env.prompt, demo.prompt):
            return "the prompt differs"
    for step, action in enumerate((*demo.actions, None)):
        when = "at the start" if step == 0 else f"after step {step - 1}"
        if env.scene != demo.scenes[step]:
            return f"object poses differ {when}"
        if not _is_same_view(observation, demo.observation(step)):
            return f"the images differ {when}"
        if action is None:
            break
        if demo.domain != "user":
            decision = env.oracle_decision()
            acted = action, demo.pick_ids[step], demo.place_ids[step]
            if (decision.action, decision.pick_id, decision.place_id) != acted:
                return f"the oracle acts differently in step {step}"
        observation, *_ = env.perform(action)
        if not np.array_equal(env.joint_path, demo.joint_paths[step]):
            return f"the joint path differs in step {step}"
    return "" if is_composed or env.outcome == demo.outcome else "the outcome differs"


def _is_same_prompt(ours: RenderedPrompt, theirs: RenderedPrompt) -> bool:
    return (ours.text, list(ours.images)) == (theirs.text, list(theirs.images)) and all(
        (a.kind, a.objects) == (b.kind, b.objects) and _are_same(a.rgb, b.rgb) and _are_same(a.segm, b.segm)
        for a, b in zip(ours.images.values(), theirs.images.values(), strict=True)
    )


def _is_same_view(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> bool:
    return ours["ee"] == theirs["ee"] and all(_are_same(ours[key], theirs[key]) for key in ("rgb", "segm"))


def _are_same(ours: Mapping[str, np.ndarray], theirs: Mapping[str, np.ndarray]) -> bool:
    return all(np.array_equal(ours[view], theirs[view]) for view in ours)


@lru_cache(maxsize=4)
def _make_env(task: str, level: str, domain: str, env_config: EnvConfig) -> "TabletopEnv":
    return env_config.make(HOST_TASK if task == COMPOSED else task, level, domain=domain)
