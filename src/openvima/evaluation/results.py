"""Results of an evaluation: outcomes of episodes, counted by policy, task and level."""

import hashlib
import json
import platform
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from openvima.atomic_io import atomic_write_file
from openvima.env.registration import ENVIRONMENT_VERSION
from openvima.errors import MAX_CHARACTERS, DatasetError, brief_repr, cut, echo
from openvima.evaluation.statistics import Interval, mean_of_rates, wilson_interval
from openvima.html import notebook_html
from openvima.imports import versions_of
from openvima.input_files import MALFORMED, as_path, read_text

K = TypeVar("K")
V = TypeVar("V")

SCHEMA = 1
FILE_NAME = "results.json"
_MAX_BYTES = 1 << 28  # a million episodes
BAD_ACTION = "invalid action"  # kind of failure
POLICY_ERROR = "the policy raised an error"  # another
NO_PROMPT = "no_prompt"  # an ablation
# What replaying the actions cannot prove.
DECLARED = "who acted (policies) and what they observed (ablation, boxes, device, precision, near_ties)"


@dataclass(frozen=True, slots=True)
class EpisodeOutcome:
    """How one episode ended. A new field needs a default, since files from before are read, too.

    Args:
        seed: The episode's seed, of domain "eval".
        success: Whether the task was done in time.
        steps: Actions taken.
        reason: Empty on success, else one sentence.
        kind: Empty on success, else the reason without names and numbers, for counting.
        resamples: Rejected starts before a valid one was sampled.
        oracle_max_steps: Steps within which the oracle must be done; None: as the row says.
        near_ties: Decisions between two classes whose scores differ by no more than rounding.
    """

    seed: int
    success: bool
    steps: int
    reason: str = ""
    kind: str = ""
    resamples: int = 0
    oracle_max_steps: int | None = None
    near_ties: int = 0


@dataclass(frozen=True, slots=True)
class Row:
    """All episodes of one policy on one task at one level.

    Args:
        policy: Name of the policy in this evaluation.
        task: Name of the task.
        level: one of `openvima.catalog.LEVELS`.
        oracle_max_steps: Steps within which the oracle must be done; the policy has two more.
        outcomes: One entry an episode, seeds ascending.
        ablation: Input ablation, see `openvima.evaluation.ablations`; empty for none.
    """

    policy: str
    task: str
    level: str
    oracle_max_steps: int
    outcomes: tuple[EpisodeOutcome, ...]
    ablation: str = ""

    __repr__ = brief_repr

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return len(self.outcomes)

    @property
    def successes(self) -> int:
        """Number of episodes solved within the time limit."""
        return sum(outcome.success for outcome in self.outcomes)

    @property
    def rate(self) -> float:
        """Success rate."""
        return self.successes / self.episodes

    @property
    def successes_oracle_horizon(self) -> int:
        """Number of episodes solved in no more steps than the oracle may take."""
        return sum(
            outcome.success and outcome.steps <= (outcome.oracle_max_steps or self.oracle_max_steps)
            for outcome in self.outcomes
        )

    @property
    def interval(self) -> Interval:
        """95 % Wilson interval of the success rate."""
        return wilson_interval(self.successes, self.episodes)

    @property
    def mean_steps(self) -> float:
        """Mean number of actions an episode, solved or not."""
        return sum(outcome.steps for outcome in self.outcomes) / max(1, self.episodes)

    @property
    def resamples(self) -> int:
        """Number of rejected starts, over all episodes."""
        return sum(outcome.resamples for outcome in self.outcomes)

    @property
    def near_ties(self) -> list[int]:
        """Seeds of episodes with near ties."""
        return [outcome.seed for outcome in self.outcomes if outcome.near_ties]

    @property
    def failures(self) -> dict[str, int]:
        """Counts of each kind of failure, most frequent first."""
        kinds = Counter(outcome.kind for outcome in self.outcomes if not outcome.success)
        return dict(sorted(kinds.items(), key=lambda item: (-item[1], item[0])))


@dataclass(frozen=True, slots=True)
class LevelMean:
    """Unweighted mean success rate of one policy over the tasks of one level."""

    policy: str
    level: str
    mean: float
    interval: Interval
    tasks: tuple[str, ...]
    ablation: str = ""


@dataclass(frozen=True, slots=True)
class Results:
    """A finished evaluation.

    Args:
        rows: In the order policy, level, task.
        config: The configuration, as plain values.
        versions: Versions of the packages that results depend on.
        policies: For each policy name what it is: {"kind": …} and for trained ones {"sha256": …},
            for remote ones {"metadata": …}. "modalities", of remote ones in their metadata, lists what
            observations held; of networks without it they were rgb and segm.
        actions_sha256: Of the recorded actions, which `verify_results` replays; empty without any.
    """

    rows: tuple[Row, ...]
    config: dict[str, Any] = field(default_factory=dict)  # plain JSON values
    versions: dict[str, str] = field(default_factory=dict)
    policies: dict[str, dict[str, Any]] = field(default_factory=dict)  # plain JSON values
    actions_sha256: str = ""

    def __repr__(self) -> str:
        rates = group_by_key(
            (f"{each.policy}, {each.ablation}".removesuffix(", "), f"{100 * each.mean:.1f} % on {each.level}")
            for each in self.level_means()
        )
        shown = "; ".join(f"{name}: {', '.join(means)}" for name, means in rates.items())
        episodes = sum(row.episodes for row in self.rows)
        return cut(f"Results(episodes: {episodes:,}; tasks: {len(self.tasks())}; {shown})", MAX_CHARACTERS)

    def _repr_html_(self) -> str | None:
        means = self.means()
        names = dict.fromkeys((policy, ablation) for policy, ablation, _ in means)
        return notebook_html("results", results=self, means=means, names=list(names))

    def policy_names(self) -> list[str]:
        """Names of the policies, in the order of the rows."""
        return list(dict.fromkeys(row.policy for row in self.rows))

    def levels(self) -> list[str]:
        """Levels that occur, in the order of the rows."""
        return list(dict.fromkeys(row.level for row in self.rows))

    def tasks(self, level: str | None = None) -> list[str]:
        """Tasks that occur, at one level or at all."""
        return list(dict.fromkeys(row.task for row in self.rows if level in (None, row.level)))

    def row(self, policy: str, task: str, level: str, ablation: str = "") -> Row | None:
        """The row of that policy, task and level, under an ablation or plain, if there is one."""
        wanted = (policy, task, level, ablation)
        return next(
            (row for row in self.rows if (row.policy, row.task, row.level, row.ablation) == wanted), None
        )

    def level_means(self) -> list[LevelMean]:
        """Mean over the tasks of each level, for each policy, plain and under each ablation."""
        return list(self.means().values())

    def means(self) -> dict[tuple[str, str, str], LevelMean]:
        """The same means by policy, ablation and level; the ablation is empty for the plain score."""
        cells = group_by_key(((row.policy, row.ablation, row.level), row) for row in self.rows)
        means = {}
        for (policy, ablation, level), rows in cells.items():
            mean = mean_of_rates([(row.successes, row.episodes) for row in rows])
            tasks = tuple(row.task for row in rows)
            means[policy, ablation, level] = LevelMean(policy, level, *mean, tasks, ablation)
        return means

    def invalid_actions(self) -> list[dict[str, Any]]:
        """Count invalid actions by policy, for the policies that have any, as JSON values."""
        return self._ended_by(BAD_ACTION, "invalid")

    def policy_errors(self) -> list[dict[str, Any]]:
        """Count exceptions of policies in `reset` and `act` by policy, as JSON values."""
        return self._ended_by(POLICY_ERROR, "raised")

    def unneeded_prompts(self) -> str:
        """Say which tasks a policy mostly solves without a prompt; empty if there is none."""
        solved = [
            f"{row.policy} solves {row.task}, {row.level}, in {row.successes} of {row.episodes} episodes"
            for row in self.rows
            if row.ablation == NO_PROMPT and row.interval[0] > 0.5
        ]
        return f"prompts are hardly needed: without one {', '.join(solved)}." if solved else ""

    def _ended_by(self, kind: str, count: str) -> list[dict[str, Any]]:
        found = []
        for policy in self.policy_names():
            rows = [row for row in self.rows if row.policy == policy]
            ended = [(row, outcome) for row in rows for outcome in row.outcomes if outcome.kind == kind]
            if ended:
                row, outcome = ended[0]
                first = f"first in {row.task}, {row.level}, seed {outcome.seed}: {outcome.reason}"
                episodes = sum(row.episodes for row in rows)
                found.append({"policy": policy, count: len(ended), "episodes": episodes, "first": first})
        return found

    def to_json(self) -> str:
        """Return the text of `results.json`; equal results give equal bytes."""
        early = {"invalid_actions": self.invalid_actions(), "policy_errors": self.policy_errors()}
        content = {
            "schema": SCHEMA,
            "rows": [_row_record(row) for row in self.rows],
            "levels": [_level_record(mean) for mean in self.level_means()],
            **{key: found for key, found in early.items() if found},
            "policies": self.policies,
            "config": self.config,
            "versions": self.versions,
            "actions_sha256": self.actions_sha256,
            "declared": DECLARED,
        }
        content["sha256"] = hashlib.sha256(_json_text(content).encode()).hexdigest()
        return _json_text(content)

    def write(self, path: str | Path) -> Path:
        """Write `results.json`; an interrupted write leaves the old file or none."""
        return atomic_write_file(as_path(path), self.to_json())

    @staticmethod
    def read(path: str | Path) -> "Results":
        """Read a `results.json`, or the one of an evaluation's folder.

        Raises:
            DatasetError: The file is missing, damaged or of another schema.
        """
        return read_results(as_path(path))[0]


def group_by_key(pairs: Iterable[tuple[K, V]]) -> dict[K, list[V]]:
    """Collect the values of each key, both in the order in which they come."""
    groups: dict[K, list[V]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def read_results(path: Path) -> tuple[Results, str]:
    """Read a `results.json`, or the one of an evaluation's folder.

    Returns:
        What its outcomes say, and its text.

    Raises:
        DatasetError: The file is missing, damaged, too large or of another schema.
    """
    path = path / FILE_NAME if path.is_dir() else path
    if not path.is_file():
        raise DatasetError(f"there is no {path}; `openvima evaluate --out FOLDER` writes one.")
    try:
        text = read_text(path, max_bytes=_MAX_BYTES)
        content = json.loads(text)
        schema = content["schema"]
        if schema == SCHEMA:
            rows = tuple(_row_from_record(record) for record in content["rows"])
            described = (content["config"], content["versions"], content["policies"])
            return Results(rows, *described, content.get("actions_sha256", "")), text
    except MALFORMED as error:
        raise DatasetError(
            f"{path} is damaged ({echo(repr(error))}); evaluate again with --force."
        ) from error
    raise DatasetError(
        f"{path} has schema {echo(repr(schema))}; this version reads schema {SCHEMA}. Evaluate again, or "
        "read it with the version of openvima that wrote it."
    )


def _json_text(content: Mapping[str, object]) -> str:
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def failure_kind(reason: str) -> str:
    """Take the names of single objects out of a reason, so that equal causes count as one.

    Example:
        >>> failure_kind("object 6 (red letter A) left the workspace")
        'object left the workspace'
    """
    return re.sub(r"\bobject \d+( \([^)]*\))?", "object", reason).strip().rstrip(".") or "unknown"


def _row_record(row: Row) -> dict[str, object]:
    return {
        "policy": row.policy,
        "task": row.task,
        "level": row.level,
        "ablation": row.ablation,
        "successes": row.successes,
        "episodes": row.episodes,
        "rate": _rounded(row.rate),
        "interval": [_rounded(end) for end in row.interval],
        "successes_oracle_horizon": row.successes_oracle_horizon,
        "oracle_max_steps": row.oracle_max_steps,
        "mean_steps": _rounded(row.mean_steps),
        "seeds": [row.outcomes[0].seed, row.outcomes[-1].seed],
        "failures": row.failures,
        "resamples": row.resamples,
        "near_ties": row.near_ties,
        "outcomes": [asdict(outcome) for outcome in row.outcomes],
    }


def _row_from_record(record: Mapping[str, Any]) -> Row:
    outcomes = tuple(EpisodeOutcome(**outcome) for outcome in record["outcomes"])
    names = (record["policy"], record["task"], record["level"])
    return Row(*names, record["oracle_max_steps"], outcomes, record.get("ablation", ""))


def _level_record(mean: LevelMean) -> dict[str, object]:
    interval = [_rounded(end) for end in mean.interval]
    return asdict(mean) | {"mean": _rounded(mean.mean), "interval": interval}


def _rounded(value: float) -> float:
    return round(value, 6)


def versions(*, with_torch: bool) -> dict[str, str]:
    """List the versions that can change the outcome of an episode.

    Args:
        with_torch: Whether networks take part.

    Returns:
        Package name to version, without importing any of them.
    """
    return {
        **versions_of("numpy", "numba", "mujoco", "gymnasium", *(["torch"] if with_torch else [])),
        "environments": f"v{ENVIRONMENT_VERSION}",
        "python": platform.python_version(),
    }
