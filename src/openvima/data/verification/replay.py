"""Replaying stored episodes: seed, oracle and actions must reproduce the same bytes.

Demonstrations of users are compared without the oracle. Of composed scenes goals and prompt are not stored:
these begin with the stored scene, and prompt and outcome are not compared.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from openvima.catalog.user_assets import recorded_assets
from openvima.data.encoding import ShardInfo
from openvima.data.records import Demonstration, package_versions
from openvima.data.shard import Shard
from openvima.data.verification.episodes import PUBLISHED
from openvima.data.verification.findings import Problem, Report, VerifyConfig, by_cause
from openvima.data.verification.inventory import Inventory
from openvima.data.verification.shards import ShardFindings
from openvima.env.config import EnvConfig
from openvima.errors import AssetError, OpenVimaError
from openvima.multiprocess import imap_unordered
from openvima.scene import COMPOSED, HOST_TASK, Episode, RenderedPrompt

if TYPE_CHECKING:  # comes with the simulator
    from openvima.env import TabletopEnv

_REMEDY = "The files are intact, but another machine or other code wrote them. Generate them again."
_IRRELEVANT = "pyarrow"  # its version decides bytes of files, not of episodes


@dataclass(frozen=True, slots=True)
class Replayed:
    """Result of replaying episodes.

    Args:
        num_episodes: Number of replayed episodes.
        problems: Shards with episodes that differ.
        notes: Episodes that could not be replayed or compared, and why.
    """

    num_episodes: int = 0
    problems: tuple[Problem, ...] = ()
    notes: tuple[str, ...] = ()


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


def replay(
    inventory: Inventory,
    findings: Mapping[str, ShardFindings],
    config: VerifyConfig,
    report: Report | None = None,
) -> Replayed:
    """Replay a sample of episodes.

    Args:
        inventory: The folder.
        findings: Results of its shards; only readable ones are replayed.
        config: Number of episodes, and the assets.
        report: Called with episodes done, episodes in all, and the current stage.
    """
    if config.replay == 0:
        return Replayed()
    tasks, refused = _runnable(_chosen(inventory, findings, config))
    total = sum(len(task.rows) for task in tasks)
    watch = None if report is None else (lambda done: report(done, total, "replaying"))
    problems, notes = [], [*_notes_on_origin(findings), *refused]
    num_replayed = 0
    for task, found in imap_unordered(replay_shard, tasks, config.workers, report=watch):
        name = task.path.name
        if isinstance(found, str):
            notes.append(f"{name} cannot be replayed: {found}")
            continue
        num_replayed += len(task.rows)
        for cause in by_cause(found, findings[name].num_episodes):
            if others := _other_versions(task.info):
                notes.append(f"{name}, written by {others}, which may be why: replayed, {cause}")
            else:
                problems.append(Problem(name, f"replayed, {cause}", _REMEDY))
    return Replayed(num_replayed, tuple(problems), tuple(notes))


def _runnable(tasks: Iterable[ReplayTask]) -> tuple[list[ReplayTask], list[str]]:
    """Tasks whose assets may be loaded, with what to load; and a note for each of the others."""
    runnable, notes = [], []
    for task in tasks:
        try:
            from_record = task.assets == task.info.assets
            assets = recorded_assets(task.assets) if from_record else task.assets
            runnable.append(replace(task, assets=assets))
        except AssetError as error:
            notes.append(f"{task.path.name} cannot be replayed: {error}")
    return runnable, notes


def replay_shard(task: ReplayTask, count: Callable[[int], None]) -> list[tuple[int, str]] | str:
    """Replay episodes of a shard.

    Args:
        task: The episodes.
        count: Called with the number of episodes replayed so far.

    Returns:
        Row and first difference of those that differ; or why none can be replayed.
    """
    shard, found = Shard(task.path), []
    try:
        env = _env(task.info.task, task.info.level, task.info.domain, _setup(task))
    except OpenVimaError as error:  # the task is not installed, or the asset pack not imported
        return str(error)
    for number, row in enumerate(task.rows, start=1):
        try:
            difference = first_difference(env, shard[row])
        except AssetError as error:
            return str(error)
        except OpenVimaError as error:
            difference = f"it stops: {error}"
        if difference:
            found.append((row, difference))
        count(number)
    return found


def first_difference(env: "TabletopEnv", demo: Demonstration) -> str:
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
        if env.scene != demo.scenes[step]:
            return f"object poses differ {_when(step)}"
        if not _is_same_view(observation, demo.observation(step)):
            return f"the images differ {_when(step)}"
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


def _chosen(
    inventory: Inventory, findings: Mapping[str, ShardFindings], config: VerifyConfig
) -> Iterator[ReplayTask]:
    """Choose a pseudorandom sample of each task by hashes of content and seed."""
    ranked: dict[str, list[tuple[bytes, str, int]]] = {}
    for name, found in findings.items():
        if found.is_damaged or found.summary is None or found.info is None or found.info.domain == PUBLISHED:
            continue
        columns = (found.summary.index.column(key).to_pylist() for key in ("task", "content_hash"))
        for row, (task, content_hash) in enumerate(zip(*columns, strict=True)):
            rank = hashlib.sha256(f"{config.seed} {content_hash}".encode()).digest()
            ranked.setdefault(task, []).append((rank, name, row))
    rows: dict[str, list[int]] = {}
    for candidates in ranked.values():
        for _, name, row in sorted(candidates)[: config.replay]:
            rows.setdefault(name, []).append(row)
    for name in sorted(rows):
        info = findings[name].info
        assert info is not None  # see above
        assets = info.assets if config.assets is None or info.assets == "procedural" else config.assets
        yield ReplayTask(inventory.folder / name, info, tuple(sorted(rows[name])), assets)


def _notes_on_origin(findings: Mapping[str, ShardFindings]) -> list[str]:
    infos = [(found.info, found.num_episodes) for found in findings.values() if found.info is not None]
    imported = sum(num for info, num in infos if info.domain == PUBLISHED)
    notes = [f"{imported} episodes are imported ones; these cannot be replayed."] if imported else []
    others = {_other_versions(info) for info, _ in infos if info.domain != PUBLISHED} - {""}
    installed = ", ".join(f"{name} {version}" for name, version in package_versions().items())
    return notes + [
        f"Written by {versions}; installed are {installed}. Only equal versions promise equal episodes."
        for versions in sorted(others)
    ]


def _other_versions(info: ShardInfo) -> str:
    """Name the versions that wrote a shard; empty if they are installed."""
    installed, wrote = package_versions(), info.versions
    if all(wrote.get(name) == version for name, version in installed.items() if name != _IRRELEVANT):
        return ""
    return ", ".join(f"{name} {version}" for name, version in wrote.items())


def _is_same_prompt(ours: RenderedPrompt, theirs: RenderedPrompt) -> bool:
    if ours.text != theirs.text or list(ours.images) != list(theirs.images):
        return False
    pairs = [(image, theirs.images[name]) for name, image in ours.images.items()]
    return all(
        (a.kind, a.objects) == (b.kind, b.objects)
        and all(np.array_equal(a.rgb[view], b.rgb[view]) for view in a.rgb)
        and all(np.array_equal(a.segm[view], b.segm[view]) for view in a.segm)
        for a, b in pairs
    )


def _is_same_view(ours: Mapping[str, object], theirs: Mapping[str, object]) -> bool:
    for key in ("rgb", "segm"):
        a, b = ours[key], theirs[key]
        assert isinstance(a, Mapping) and isinstance(b, Mapping)
        if not all(np.array_equal(a[view], b[view]) for view in a):
            return False
    return ours["ee"] == theirs["ee"]


def _when(step: int) -> str:
    return "at the start" if step == 0 else f"after step {step - 1}"


def _setup(task: ReplayTask) -> EnvConfig:
    return replace(task.info.env_config, assets=task.assets)


@lru_cache(maxsize=4)
def _env(task: str, level: str, domain: str, env_config: EnvConfig) -> "TabletopEnv":
    return env_config.make(HOST_TASK if task == COMPOSED else task, level, domain=domain)
