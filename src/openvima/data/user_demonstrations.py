"""Demonstrations by users: their own successes, written to a data folder of the ordinary format.

Only episodes of level "train" and domain "user" are taken, sampled or composed: nothing of an evaluation, and
nothing of levels L1 to L4, becomes training data.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from openvima.atomic_io import folder_lock
from openvima.catalog.packs import load_assets
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import MANIFEST_NAME, finish_folder, read_manifest, storage_errors
from openvima.data.records import Demonstration, Rollout, package_versions
from openvima.data.shard import Shard, ShardWriter
from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.env.tabletop import TabletopEnv
from openvima.errors import DatasetError, EpisodeError
from openvima.input_files import as_path
from openvima.render.raycast import object_below
from openvima.scene import COMPOSED, HOST_TASK, Action, Episode, Scene
from openvima.scene.goal import object_of
from openvima.tasks import list_tasks
from openvima.tasks.oracle import TIED_TO_TABLE

COMMAND = "openvima studio"  # what manifests name as their maker
DOMAIN, LEVEL = "user", "train"
_MOVED_M = 0.002
_LOCK_S = 10.0  # to wait for another session that records


def check_recordable(episode: Episode, *, env_config: EnvConfig = DEFAULT_ENV_CONFIG) -> None:
    """Check that demonstrations of an episode may be recorded.

    Args:
        episode: The episode.
        env_config: Settings that it was sampled with.

    Raises:
        DatasetError: It is of an evaluation level or an evaluation, it has no goals, or its task samples
            another episode for its seed.
    """
    named = f"the episode ({episode.task}, {episode.level}, {episode.domain} seed {episode.seed})"
    if (episode.level, episode.domain) != (LEVEL, DOMAIN):
        raise DatasetError(
            f"{named} stays unseen; demonstrations are recorded at level {LEVEL}, for seeds of domain "
            f"{DOMAIN} and composed scenes."
        )
    if not episode.problem.goals:
        raise DatasetError(f"{named} has no goals, so it is never solved; give it some to record it.")
    if episode.task == COMPOSED:
        return
    known = episode.task in list_tasks()
    if not known or env_config.sample(episode.task, LEVEL, episode.seed, domain=DOMAIN) != episode:
        raise DatasetError(f"{named} is not what the task samples for this seed; compose it to record it.")


def demonstrate(
    episode: Episode, actions: Sequence[Action], *, env_config: EnvConfig = DEFAULT_ENV_CONFIG
) -> Demonstration:
    """Execute actions and return the demonstration, with the objects that each action refers to.

    Args:
        episode: A sampled or composed episode.
        actions: The actions of a user.
        env_config: Settings that the episode was sampled with.

    Returns:
        The demonstration; composed ones get their seed from their content, so that no two share one.

    Raises:
        DatasetError: The actions do not solve the episode, or one of them moves nothing.
        ActionError: An action is invalid.
    """
    is_composed = episode.task == COMPOSED
    env = env_config.make(HOST_TASK if is_composed else episode.task, LEVEL, domain=DOMAIN)
    observation, _ = env.reset(options={"episode": episode})
    rollout, pick_ids, place_ids = Rollout(env, observation), [], []
    for number, action in enumerate(actions, start=1):
        before, open_goals = env.scene, env.progress.open_goals
        try:
            grasped = rollout.step(action)["grasped"]
        except EpisodeError as error:
            raise DatasetError(f"action {number} of {len(actions)} is one too many: {error}") from None
        pick_id = grasped or _find_moved(before, env.scene)
        if pick_id is None:
            raise DatasetError(f"action {number} moves nothing; go back and repeat it before recording.")
        met = [g for g in open_goals if g not in env.progress.open_goals]
        pick_ids.append(pick_id)
        place_ids.append(_infer_place(env, before, pick_id, met))
    if not env.outcome.success:
        reason = env.outcome.reason or f"not solved after {len(actions)} actions"
        raise DatasetError(f"only successes are recorded, and this episode is not one: {reason}.")
    demo = rollout.demonstration(pick_ids, place_ids)
    return replace(demo, seed=int(demo.content_hash()[:15], 16)) if is_composed else demo


def record_demonstration(
    folder: str | Path,
    episode: Episode,
    actions: Sequence[Action],
    *,
    env_config: EnvConfig = DEFAULT_ENV_CONFIG,
) -> int:
    """Append a success of a user to a data folder, which is complete after every call.

    Args:
        folder: A folder of recorded demonstrations, or one to make.
        episode: An episode of level "train" and domain "user", or a composed one with goals.
        actions: The actions that solve it; they are executed again.
        env_config: Settings that the episode was sampled with.

    Returns:
        Number of demonstrations in the folder.

    Raises:
        DatasetError: The episode must not be recorded, the actions do not solve it, the folder holds other
            data, or a demonstration of the same episode.
        FolderLockedError: Another process writes to the folder.
        StorageError: The folder cannot be written to.

    Example:
        >>> actions = [Action.planar((0.45, -0.25), (0.55, 0.25))]
        >>> record_demonstration("mine", openvima.load_episode("scene.yaml"), actions)  # doctest: +SKIP
        1
    """
    check_recordable(episode, env_config=env_config)
    if episode.task == COMPOSED:
        env_config = EnvConfig(env_config.assets, env_config.compat)  # the others are of tasks
    demo, folder = demonstrate(episode, actions, env_config=env_config), as_path(folder)
    with storage_errors(folder, list(folder.glob("*.arrow"))):
        folder.mkdir(parents=True, exist_ok=True)
        with folder_lock(folder, timeout_s=_LOCK_S):
            _append(folder, demo, env_config)
            config, paths = {"level": LEVEL, "domain": DOMAIN}, sorted(folder.glob("*.arrow"))
            finish_folder(folder, paths, command=COMMAND, config=config, versions=package_versions())
            return read_manifest(folder)["counts"]["episodes"]


def _append(folder: Path, demo: Demonstration, env_config: EnvConfig) -> None:
    """Write a shard with one episode, so that those before stay as they are.

    Raises:
        DatasetError: The folder holds other data than demonstrations of users, or this one already.
        DatasetError: A shard is damaged.
    """
    shards = [Shard(path) for path in sorted(folder.glob("*.arrow"))]
    if any(shard.info.domain != DOMAIN for shard in shards):
        raise DatasetError(
            f"{folder} holds other data; give a folder of recorded demonstrations or a new one."
        )
    same = [shard for shard in shards if shard.info.task == demo.task]
    settings = {**env_config.record(), "assets": load_assets(env_config.assets).name}
    info = ShardInfo(demo.task, LEVEL, DOMAIN, len(same), 1, 0, versions=package_versions(), **settings)
    for shard in same:
        seeds = shard.table(["seed"]).column("seed").to_pylist()
        if shard.info.env_config == info.env_config and demo.seed in seeds:
            if not (folder / MANIFEST_NAME).is_file():
                return  # recording it was interrupted
            raise DatasetError(
                f"{folder} holds a demonstration of this episode already ({demo.task}, seed {demo.seed}); "
                "go on with another seed or scene."
            )
    (folder / MANIFEST_NAME).unlink(missing_ok=True)
    with ShardWriter(folder / info.file_name, info) as writer:
        writer.write(demo)


def _find_moved(before: Scene, after: Scene) -> int | None:
    """The object that moved farthest; None if all are where they were."""
    pairs = zip(before.placements, after.placements, strict=True)
    moved = {old.id: old.pose.planar_distance(new.pose) for old, new in pairs}
    farthest = max(moved, key=moved.__getitem__)
    return farthest if moved[farthest] > _MOVED_M else None


def _infer_place(env: TabletopEnv, before: Scene, pick_id: int, met: Sequence[int]) -> int:
    """The object relative to which another was placed: of a goal that was met, else what lies below it."""
    goals = env.episode.problem.goals
    is_sweep = before.end_effector == "spatula"
    for goal in goals if is_sweep else [goals[number] for number in met]:
        relative_to = getattr(goal, "relative_to", None)
        if object_of(goal) == pick_id and relative_to is not None:
            return relative_to
    if is_sweep:
        return TIED_TO_TABLE
    pose = env.scene[pick_id].pose
    others = [placement for placement in before.placements if placement.id != pick_id]
    if below := object_below(others, (pose.x, pose.y), env.assets):
        return below
    return pick_id if pose.planar_distance(before[pick_id].pose) < _MOVED_M else TIED_TO_TABLE
