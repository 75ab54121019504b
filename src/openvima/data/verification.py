"""Verifying a data folder: manifest, index, shards, and a sample of replayed episodes.

Nothing is changed. What is damaged is named, with the command that makes it again.

Replaying an episode, seed, oracle and actions must reproduce the same bytes. Demonstrations of users are
compared without the oracle. Of composed scenes goals and prompt are not stored: these begin with the stored
scene, and prompt and outcome are not compared.
"""

import hashlib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from openvima.catalog.packs import load_assets, recorded_assets
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import (
    INDEX_NAME,
    MANIFEST_NAME,
    fingerprint,
    parse_index,
    parse_manifest,
    split_index,
)
from openvima.data.planning import COMMAND, generate_command
from openvima.data.reader import explain_missing
from openvima.data.records import Demonstration, package_versions
from openvima.data.shard import Shard, remedy
from openvima.env.config import EnvConfig
from openvima.errors import AssetError, ConfigError, DatasetError, OpenVimaError, echo
from openvima.input_files import as_path
from openvima.multiprocess import Report, check_workers, imap_unordered
from openvima.scene import COMPOSED, HOST_TASK, Episode, RenderedPrompt
from openvima.user_code import is_code

if TYPE_CHECKING:  # comes with the simulator
    from openvima.env import TabletopEnv

_PUBLISHED = "published"  # domain of imported demonstrations
_MAX_ROWS_NAMED = 8
_NOT_AGAIN = "The files are intact, but another machine or other code wrote them. Generate them again."


@dataclass(frozen=True, slots=True)
class VerifyConfig:
    """Settings of a verification.

    Args:
        replay: Episodes of each task to replay in the simulator; None means all.
        seed: Decides which episodes are replayed.
        assets: Asset pack to replay with, as for `openvima generate`; None means the one of that name.
        workers: Number of processes.

    Raises:
        ConfigError: A number is out of its range.
    """

    replay: int | None = 1
    seed: int = 0
    assets: str | None = None
    workers: int = 1

    def __post_init__(self) -> None:
        if self.replay is not None and self.replay < 0:
            raise ConfigError(f"replay is {self.replay}; it must be 0 or more, or all.")
        check_workers(self.workers)


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """A problem of one file.

    Args:
        file: Name of the file, relative to the data folder.
        cause: What is wrong with it.
        remedy: What to do.
    """

    file: str
    cause: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.file}: {self.cause}. {self.remedy}"


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of a verification.

    Args:
        folder: The data folder.
        problems: All problems, by file.
        notes: Remarks that are no problems.
        num_shards: Shards that were checked.
        num_episodes: Episodes that were decoded and compared with their content hashes.
        num_replayed: Episodes that were replayed.
    """

    folder: Path
    problems: tuple[Problem, ...]
    notes: tuple[str, ...] = ()
    num_shards: int = 0
    num_episodes: int = 0
    num_replayed: int = 0

    @property
    def is_clean(self) -> bool:
        """Whether there are no problems."""
        return not self.problems

    def record(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return {
            "folder": str(self.folder),
            "clean": self.is_clean,
            "shards": self.num_shards,
            "episodes": self.num_episodes,
            "replayed": self.num_replayed,
            "problems": [asdict(problem) for problem in self.problems],
            "notes": list(self.notes),
        }


DEFAULT = VerifyConfig()


def verify(folder: str | Path, config: VerifyConfig = DEFAULT, report: Report | None = None) -> Verification:
    """Find all problems of a data set; nothing is changed.

    Args:
        folder: Folder of demonstrations.
        config: How thoroughly to verify.
        report: Called with episodes done, episodes in all, and the current stage.

    Returns:
        The result.

    Raises:
        DatasetError: There is no data set.
        ConfigError: The assets are a function that is missing or fails.
        WorkerError: A worker died.
    """
    folder = as_path(folder)
    if config.assets is not None and is_code(config.assets):
        load_assets(config.assets)
    return _Verifier(folder, config, report).run()


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


@dataclass(frozen=True, slots=True, eq=False)
class _ShardTask:
    """A shard to check.

    Args:
        path: The file.
        entry: Its entry in the manifest; None where that cannot be trusted.
        num_episodes: As the index says; 0 where that cannot be trusted.
    """

    path: Path
    entry: dict[str, Any] | None
    num_episodes: int


@dataclass(frozen=True, slots=True, eq=False)
class _Checked:
    """Result of checking a shard.

    Args:
        causes: What is wrong with it.
        info: Its metadata; None if it is damaged.
        content_hashes: Of its records; empty if it is damaged.
    """

    causes: Sequence[str]
    info: ShardInfo | None = None
    content_hashes: Sequence[str] = ()


@dataclass(slots=True)
class _Verifier:
    """Verifies one folder."""

    folder: Path
    config: VerifyConfig
    report: Report | None
    manifest: dict[str, Any] | None = None  # None if it cannot be trusted
    index: pa.Table | None = None  # likewise
    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def run(self) -> Verification:
        """Check everything; later checks use what earlier ones have found to be whole."""
        shards = sorted(path.name for path in self.folder.glob("*.arrow"))
        if not shards and not (self.folder / MANIFEST_NAME).is_file():
            raise DatasetError(explain_missing(self.folder))
        self._read_manifest_and_index()
        unlisted = "If a run was stopped, repeat its command; otherwise move the file elsewhere."
        listed = shards if self.manifest is None else self.manifest["shards"]
        for name in shards:
            if name not in listed:
                self._add(name, "the manifest does not list it", unlisted)
        for path in sorted(self.folder.glob(".*.tmp")):
            cause = "a process was killed while it wrote this, or is writing it. If not, delete it."
            self.notes.append(f"{path}: {cause}")
        tasks = self._shard_tasks(shards)
        total = sum(task.num_episodes for task in tasks)
        results = {task.path.name: found for task, found in self._map(check_shard, tasks, total, "comparing")}
        checked = {task.path.name: results[task.path.name] for task in tasks}
        for name, found in checked.items():
            for cause in found.causes:
                self._add(name, cause, self._remedy)
        num_replayed = self._replay(checked)
        return Verification(
            self.folder,
            tuple(sorted(self.problems)),
            tuple(self.notes),
            num_shards=len(tasks),
            num_episodes=sum(len(found.content_hashes) for found in checked.values()),
            num_replayed=num_replayed,
        )

    @property
    def _is_generated(self) -> bool:
        return self.manifest is not None and self.manifest["command"] == COMMAND

    @property
    def _remedy(self) -> str:
        """What makes a file of the folder again."""
        if self.manifest is None:
            return "Delete it, or restore it from a copy, and repeat the command that wrote the folder."
        if not self._is_generated:
            command = echo(self.manifest["command"])
            return f"Restore it from a copy, or delete the folder and write it again with `{command}`."
        command = generate_command(self.folder, self.manifest["config"])
        return f"Delete it and make it again: `{echo(command, len(command))}`"

    def _add(self, file: str, cause: str, remedy: str) -> None:
        self.problems.append(Problem(file, cause, remedy))

    def _map(
        self, job: Callable[..., Any], tasks: Sequence[Any], total: int, stage: str
    ) -> Iterator[tuple[Any, Any]]:
        report = self.report
        watch = None if report is None else (lambda done: report(done, max(done, total), stage))
        return imap_unordered(job, tasks, self.config.workers, report=watch)

    def _read_manifest_and_index(self) -> None:
        try:
            self.manifest = parse_manifest((self.folder / MANIFEST_NAME).read_bytes())
        except FileNotFoundError:
            self._add(MANIFEST_NAME, "it is missing", "Repeat the command that wrote the folder.")
        except DatasetError as error:
            self._add(MANIFEST_NAME, str(error), self._remedy)
        try:
            content = (self.folder / INDEX_NAME).read_bytes()
            self.index = None if self.manifest is None else parse_index(content, self.manifest)
        except FileNotFoundError:
            self._add(INDEX_NAME, "it is missing", self._remedy)
        except DatasetError as error:
            self._add(INDEX_NAME, str(error), self._remedy)

    def _shard_tasks(self, found: Sequence[str]) -> list[_ShardTask]:
        """Return the manifest's shards in the order of the data set; without a manifest, all files."""
        manifest, index = self.manifest, self.index
        parts = {} if index is None else split_index(index)
        listed = found if manifest is None else [*parts, *sorted(manifest["shards"].keys() - parts.keys())]
        return [
            _ShardTask(
                path=self.folder / name,
                entry=None if manifest is None else manifest["shards"][name],
                num_episodes=parts[name].num_rows if name in parts else 0,
            )
            for name in listed
        ]

    def _replay(self, checked: Mapping[str, _Checked]) -> int:
        """Replay a sample of episodes; return their number."""
        if self.config.replay == 0:
            return 0
        self.notes += _notes_on_origin(checked)
        tasks = []
        for name, rows in self._choose(checked):
            info = checked[name].info
            assert info is not None  # or its episodes are not chosen
            asked = None if info.assets == "procedural" else self.config.assets
            try:
                assets = asked or recorded_assets(info.assets)
                tasks.append(ReplayTask(self.folder / name, info, rows, assets))
            except AssetError as error:
                self.notes.append(f"{name} cannot be replayed: {error}")
        num_replayed, total = 0, sum(len(task.rows) for task in tasks)
        for task, found in self._map(replay_shard, tasks, total, "replaying"):
            name = task.path.name
            if isinstance(found, str):
                self.notes.append(f"{name} cannot be replayed: {found}")
                continue
            num_replayed += len(task.rows)
            for cause in _by_cause(found, len(checked[name].content_hashes)):
                if others := _other_versions(task.info):
                    self.notes.append(f"{name}, written by {others}, which may be why: replayed, {cause}")
                else:
                    self._add(name, f"replayed, {cause}", _NOT_AGAIN)
        return num_replayed

    def _choose(self, checked: Mapping[str, _Checked]) -> Iterator[tuple[str, tuple[int, ...]]]:
        """Choose a pseudorandom sample of each task by hashes of content and seed: shards and their rows."""
        ranked: dict[str, list[tuple[bytes, str, int]]] = {}
        for name, found in checked.items():
            if found.info is None or found.info.domain == _PUBLISHED:
                continue
            for row, content_hash in enumerate(found.content_hashes):
                rank = hashlib.sha256(f"{self.config.seed} {content_hash}".encode()).digest()
                ranked.setdefault(found.info.task, []).append((rank, name, row))
        chosen = [place for places in ranked.values() for place in sorted(places)[: self.config.replay]]
        for name, places in itertools.groupby(sorted(chosen, key=lambda c: c[1:]), key=lambda c: c[1]):
            yield name, tuple(row for *_, row in places)


def check_shard(task: _ShardTask, count: Callable[[int], None]) -> _Checked:
    """Check a shard; `count` is called with the number of episodes checked so far."""
    if not task.path.is_file():
        return _Checked(["it is missing"])
    if task.entry is not None:
        found = fingerprint(task.path)
        if (found["bytes"], found["sha256"]) != (task.entry["bytes"], task.entry["sha256"]):
            expected = f"{found['bytes']:,} of {task.entry['bytes']:,}"
            return _Checked([f"its {expected} bytes are not those that were written"])
    try:
        shard = Shard(task.path)
        hashes = shard.table(["content_hash"]).column(0).to_pylist()
    except DatasetError as error:
        return _Checked([_bare_cause(error, task.path)])
    faults = list(_find_record_faults(shard, hashes, count))
    causes = _by_cause(((row, cause) for row, cause, _ in faults), len(shard))
    is_damaged = any(is_damage for *_, is_damage in faults)
    return _Checked(causes) if is_damaged else _Checked(causes, shard.info, hashes)


def _bare_cause(error: OpenVimaError, path: Path) -> str:
    """Return a reader's error message without file, record and remedy, which a problem adds."""
    text = str(error).removesuffix(f" {remedy(path.parent)}").removesuffix(".")
    return re.sub(rf"^{re.escape(str(path))}(, record \d+)?: (record \d+ of \d+ is )?", "", text)


def _find_record_faults(
    shard: Shard, hashes: Sequence[str], count: Callable[[int], None]
) -> Iterator[tuple[int, str, bool]]:
    """Yield row, fault, and whether damaged bytes are the cause."""
    for row, content_hash in enumerate(hashes):
        try:
            demo = shard[row]
        except DatasetError as error:
            yield row, _bare_cause(error, shard.path), shard.info.images
            continue
        except OpenVimaError as error:  # the asset pack that its images need is not there
            yield row, f"its images cannot be rendered: {error}", False
            continue
        # Rendered images were compared on reading.
        if shard.info.images and demo.content_hash() != content_hash:
            yield row, "its content hash is not that of its content", True
        count(row + 1)


def _notes_on_origin(checked: Mapping[str, _Checked]) -> Iterator[str]:
    infos = [(each.info, len(each.content_hashes)) for each in checked.values() if each.info is not None]
    if imported := sum(num for info, num in infos if info.domain == _PUBLISHED):
        yield f"{imported} episodes are imported ones; these cannot be replayed."
    others = {_other_versions(info) for info, _ in infos if info.domain != _PUBLISHED} - {""}
    installed = ", ".join(f"{name} {version}" for name, version in package_versions().items())
    for versions in sorted(others):
        yield f"Written by {versions}; installed are {installed}. Only equal versions promise equal episodes."


def _other_versions(info: ShardInfo) -> str:
    """Name the versions that wrote a shard; empty if they are installed."""
    wrote = info.versions
    # The version of pyarrow decides bytes of files, not of episodes.
    if all(wrote.get(name) == version for name, version in package_versions().items() if name != "pyarrow"):
        return ""
    return ", ".join(f"{name} {version}" for name, version in wrote.items())


def _by_cause(faults: Iterable[tuple[int, str]], num_rows: int) -> list[str]:
    """Group faults of records by cause: one text per cause, with the rows."""
    rows: dict[str, list[int]] = {}
    for row, cause in faults:
        rows.setdefault(cause, []).append(row)
    return [
        f"{cause} (record {', '.join(map(str, found[:_MAX_ROWS_NAMED]))}"
        f"{' …' if len(found) > _MAX_ROWS_NAMED else ''} of {num_rows})"
        for cause, found in rows.items()
    ]


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
