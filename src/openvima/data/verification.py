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
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from openvima.catalog.packs import load_assets, recorded_assets
from openvima.data.encoding import ShardInfo, encode
from openvima.data.generation import COMMAND, generate_command
from openvima.data.manifest import (
    INDEX_NAME,
    MANIFEST_NAME,
    explain_missing,
    fingerprint,
    parse_index,
    parse_manifest,
)
from openvima.data.records import Demonstration, Rollout, make_env, package_versions, rollout_oracle
from openvima.data.schema import COLUMNS
from openvima.data.shard import Shard, remedy
from openvima.errors import AssetError, ConfigError, DatasetError, OpenVimaError, echo
from openvima.input_files import as_path
from openvima.multiprocess import Report, check_workers, imap_unordered
from openvima.scene import COMPOSED, HOST_TASK, Episode
from openvima.user_code import is_code

if TYPE_CHECKING:  # comes with the simulator
    from openvima.env import TabletopEnv

_PUBLISHED = "published"  # domain of imported demonstrations
# Columns that follow from goals and prompt, which shards of composed scenes do not have.
_OF_GOALS_AND_PROMPT = ("redraws", "success", "failure", "reason")
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


@dataclass(frozen=True, slots=True, eq=False)
class _Whole:
    """A shard that is not damaged.

    Args:
        info: Its metadata.
        content_hashes: Of its records.
    """

    info: ShardInfo
    content_hashes: Sequence[str]


@dataclass(slots=True)
class _Verifier:
    """Verifies one folder."""

    folder: Path
    config: VerifyConfig
    report: Report | None
    manifest: dict[str, Any] | None = None  # None if it cannot be trusted
    problems: list[Problem] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def run(self) -> Verification:
        """Check everything; later checks use what earlier ones have found to be whole."""
        shards = sorted(path.name for path in self.folder.glob("*.arrow"))
        if not shards and not (self.folder / MANIFEST_NAME).is_file():
            raise DatasetError(explain_missing(self.folder))
        manifest = self.manifest = self._read(MANIFEST_NAME, parse_manifest)
        self._read(INDEX_NAME, lambda content: manifest and parse_index(content, manifest))
        unlisted = "If a run was stopped, repeat its command; otherwise move the file elsewhere."
        entries = dict.fromkeys(shards) if manifest is None else manifest["shards"]
        for name in shards:
            if name not in entries:
                self._add(name, "the manifest does not list it", unlisted)
        for path in sorted(self.folder.glob(".*.tmp")):
            cause = "a process was killed while it wrote this, or is writing it. If not, delete it."
            self.notes.append(f"{path}: {cause}")
        tasks = [(self.folder / name, entry) for name, entry in entries.items()]
        total = sum(entry["episodes"] for entry in entries.values() if entry)
        whole: dict[str, _Whole] = {}
        for (path, _), found in self._map(check_shard, tasks, total, "comparing"):
            if isinstance(found, _Whole):
                whole[path.name] = found
            else:
                for cause in found:
                    self._add(path.name, cause)
        num_replayed = self._replay(whole)
        return Verification(
            self.folder,
            tuple(sorted(self.problems)),
            tuple(self.notes),
            num_shards=len(tasks),
            num_episodes=sum(len(found.content_hashes) for found in whole.values()),
            num_replayed=num_replayed,
        )

    @property
    def _remedy(self) -> str:
        """What makes a file of the folder again."""
        if self.manifest is None:
            return "Restore it from a copy, or delete it and repeat the command that wrote the folder."
        if self.manifest["command"] != COMMAND:
            command = echo(self.manifest["command"])
            return f"Restore it from a copy, or delete the folder and write it again with `{command}`."
        command = generate_command(self.folder, self.manifest["config"])
        return f"Delete it and make it again: `{echo(command, len(command))}`"

    def _add(self, file: str, cause: str, remedy: str = "") -> None:
        self.problems.append(Problem(file, cause, remedy or self._remedy))

    def _map(
        self, job: Callable[..., Any], tasks: Sequence[Any], total: int, stage: str
    ) -> Iterator[tuple[Any, Any]]:
        report = self.report
        watch = report and (lambda done: report(done, max(done, total), stage))
        return imap_unordered(job, tasks, self.config.workers, report=watch)

    def _read(self, name: str, parse: Callable[[bytes], Any]) -> Any:
        """Read a file of the folder; None, and a problem, if it is missing or damaged."""
        try:
            return parse((self.folder / name).read_bytes())
        except FileNotFoundError:
            self._add(name, "it is missing")
        except DatasetError as error:
            self._add(name, str(error))
        return None

    def _replay(self, whole: Mapping[str, _Whole]) -> int:
        """Replay a sample of episodes; return their number."""
        if self.config.replay == 0:
            return 0
        self.notes += _notes_on_origin(whole)
        tasks = [(self.folder / name, rows) for name, rows in self._choose(whole)]
        num_replayed, total = 0, sum(len(rows) for _, rows in tasks)
        job = partial(replay_shard, assets=self.config.assets)
        for (path, rows), found in self._map(job, tasks, total, "replaying"):
            name = path.name
            if isinstance(found, str):
                self.notes.append(f"{name} cannot be replayed: {found}")
                continue
            num_replayed += len(rows)
            for cause in _by_cause(found, len(whole[name].content_hashes)):
                if _other_versions(whole[name].info):
                    self.notes.append(f"{name}, written by other versions: replayed, {cause}")
                else:
                    self._add(name, f"replayed, {cause}", _NOT_AGAIN)
        return num_replayed

    def _choose(self, whole: Mapping[str, _Whole]) -> Iterator[tuple[str, tuple[int, ...]]]:
        """Choose a pseudorandom sample of each task by hashes of content and seed: shards and their rows."""
        ranked: dict[str, list[tuple[bytes, str, int]]] = {}
        for name, found in whole.items():
            if found.info.domain != _PUBLISHED:
                places = ranked.setdefault(found.info.task, [])
                for row, content_hash in enumerate(found.content_hashes):
                    rank = hashlib.sha256(f"{self.config.seed} {content_hash}".encode()).digest()
                    places.append((rank, name, row))
        chosen = sorted(p[1:] for places in ranked.values() for p in sorted(places)[: self.config.replay])
        for name, places in itertools.groupby(chosen, key=itemgetter(0)):
            yield name, tuple(row for _, row in places)


def check_shard(
    task: tuple[Path, dict[str, Any] | None], count: Callable[[int], None]
) -> _Whole | Sequence[str]:
    """Check a shard.

    Args:
        task: The file, and its entry in the manifest; None where that cannot be trusted.
        count: Called with the number of episodes checked so far.

    Returns:
        What it holds; or what is wrong with it.
    """
    path, entry = task
    if not path.is_file():
        return ["it is missing"]
    if entry is not None:
        found = fingerprint(path)
        if not found.items() <= entry.items():
            expected = f"{found['bytes']:,} of {entry['bytes']:,}"
            return [f"its {expected} bytes are not those that were written"]
    try:
        shard = Shard(path)
        hashes = shard.table(["content_hash"]).column(0).to_pylist()
    except DatasetError as error:
        return [_bare_cause(error, path)]
    return _by_cause(_find_record_faults(shard, hashes, count), len(shard)) or _Whole(shard.info, hashes)


def _bare_cause(error: OpenVimaError, path: Path) -> str:
    """Return a reader's error message without file, record and remedy, which a problem adds."""
    text = str(error).removesuffix(f" {remedy(path.parent)}").removesuffix(".")
    return re.sub(rf"^{re.escape(str(path))}(, record \d+)?: (record \d+ of \d+ is )?", "", text)


def _find_record_faults(
    shard: Shard, hashes: Sequence[str], count: Callable[[int], None]
) -> Iterator[tuple[int, str]]:
    for row, content_hash in enumerate(hashes):
        try:
            demo = shard[row]
        except DatasetError as error:
            yield row, _bare_cause(error, shard.path)
            continue
        except OpenVimaError as error:  # the asset pack that its images need is not there
            yield row, f"its images cannot be rendered: {error}"
            continue
        # Rendered images were compared on reading.
        if shard.info.images and demo.content_hash() != content_hash:
            yield row, "its content hash is not that of its content"
        count(row + 1)


def _notes_on_origin(whole: Mapping[str, _Whole]) -> Iterator[str]:
    infos = [each.info for each in whole.values()]
    if any(info.domain == _PUBLISHED for info in infos):
        yield "Imported episodes cannot be replayed."
    others = {_other_versions(info) for info in infos if info.domain != _PUBLISHED} - {""}
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
    """Group faults of records by cause: one text per cause."""
    rows: dict[str, list[int]] = {}
    for row, cause in faults:
        rows.setdefault(cause, []).append(row)
    return [
        f"{cause} ({len(found)} of {num_rows} records, first {found[0]})" for cause, found in rows.items()
    ]


def replay_shard(
    task: tuple[Path, tuple[int, ...]], count: Callable[[int], None], *, assets: str | None
) -> list[tuple[int, str]] | str:
    """Replay episodes of a shard.

    Args:
        task: The file, and its records to replay.
        count: Called with the number of episodes replayed so far.
        assets: Asset pack to replay with, as in `VerifyConfig`.

    Returns:
        Row and differences of those that differ; or why none can be replayed.
    """
    path, rows = task
    shard, found = Shard(path), []
    info = shard.info
    try:
        name = HOST_TASK if info.task == COMPOSED else info.task
        asked = None if info.assets == "procedural" else assets
        env_config = replace(info.env_config, assets=asked or recorded_assets(info.assets))
        env = make_env(name, info.level, info.domain, env_config)
    except OpenVimaError as error:  # the task is not installed, or the asset pack not imported
        return str(error)
    for number, row in enumerate(rows, start=1):
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
    """Replay a demonstration and compare all its columns.

    Args:
        env: An environment of the same task, level and settings.
        demo: The demonstration.

    Returns:
        Names of the columns that differ; empty if there are none.

    Raises:
        SamplingError: The task no longer samples an episode for the seed.
        OracleError: The oracle no longer finds an action.
        EpisodeError: The episode ends before the last action.
    """
    is_composed = demo.task == COMPOSED
    if demo.domain == "user":
        options = None
        if is_composed:
            options = {"episode": Episode.of_scene(demo.scenes[0], seed=demo.seed, max_steps=demo.max_steps)}
        observation, _ = env.reset(seed=demo.seed, options=options)
        rollout = Rollout(env, observation)
        for action in demo.actions:
            rollout.step(action)
        replayed = rollout.demonstration(demo.pick_ids, demo.place_ids)
    else:
        replayed = rollout_oracle(env, demo.seed)
    ours, theirs = encode(replayed), encode(demo)
    differing = [
        name
        for name in COLUMNS.names
        if name != "content_hash"  # which also counts the name of the assets
        and not (is_composed and (name in _OF_GOALS_AND_PROMPT or name.startswith("prompt")))
        and not ours.column(name).equals(theirs.column(name))
    ]
    return f"it differs in {', '.join(differing)}" if differing else ""
