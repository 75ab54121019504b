"""Verification of results: the recorded actions are played again, without the policy."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from openvima.atomic_io import atomic_write_file
from openvima.catalog.packs import recorded_assets
from openvima.data.chat import UNREADABLE
from openvima.env.config import EnvConfig
from openvima.errors import DatasetError, OpenVimaError, differences, echo
from openvima.evaluation.ablations import ablated_environment
from openvima.evaluation.actions import ActionReplay, read_actions
from openvima.evaluation.config import DEFAULT_DEVICE, EvaluationConfig, cells
from openvima.evaluation.results import (
    FILE_NAME,
    EpisodeOutcome,
    Results,
    Row,
    group_by_key,
    read_results,
    versions,
)
from openvima.evaluation.rollout import BAD_ACTION, NO_ORACLE_ACTION, POLICY_ERROR, play
from openvima.evaluation.runner import Report
from openvima.input_files import MALFORMED, read_json
from openvima.multiprocess import imap_unordered
from openvima.policies.naming import ORACLE

VERIFICATION_NAME = "verification.json"
_SIMULATOR = ("environments", "mujoco")  # versions that decide what an action does
# No action was executed; which one was given, or what was raised, is not recorded.
_ENDED_EARLY = (BAD_ACTION, NO_ORACLE_ACTION, POLICY_ERROR, UNREADABLE)
_BATCH = 16  # episodes of one job


@dataclass(frozen=True, slots=True)
class VerifiedResults:
    """What a verification found.

    Args:
        episodes: Episodes that were played again.
        problems: What contradicts the file, one sentence each; empty if all is confirmed.
        sha256: Digest that the file names.
    """

    episodes: int
    problems: tuple[str, ...]
    sha256: str

    @property
    def is_verified(self) -> bool:
        """Whether every outcome, count, seed and version is confirmed."""
        return not self.problems


@dataclass(frozen=True, slots=True, eq=False)
class _Replay:
    """Some episodes of a row, with their recorded actions."""

    row: Row  # with the outcomes of these episodes only
    actions: Sequence[np.ndarray]
    env_config: EnvConfig


def verify_results(
    folder: Path, *, workers: int = 1, assets: str | None = None, report: Report | None = None
) -> VerifiedResults:
    """Confirm an evaluation from its recorded actions.

    The digest, all counts and the list of episodes are checked first. Then every episode is sampled from its
    seed and its actions are executed again, with neither policy nor images. If everything is confirmed,
    `verification.json` beside the results says so.

    Args:
        folder: Folder with `results.json` and `actions.arrow`.
        workers: Processes.
        assets: Folder of the original asset pack, or MODULE:FUNCTION or FILE.py:FUNCTION, for results
            obtained with them.
        report: Called with episodes done, episodes in all and a note.

    Raises:
        DatasetError: A file is missing, unreadable, or of an evaluation of other versions of the simulator.
        ConfigError: `workers` is out of range, or there are no such assets.
        AssetError: The results name a function as their assets; pass it as `assets`.
    """
    path = folder / FILE_NAME
    results, text = read_results(path)
    try:
        stated, problems = _stated(results, text)
        config = recorded_config(results, assets)
        problems += _row_problems(results, config)
        _check_simulator(path, results.versions)
        actions, sha256 = read_actions(folder, results.rows)
    except MALFORMED as error:
        if isinstance(error, OpenVimaError):
            raise
        raise DatasetError(f"{path} is damaged ({echo(repr(error))}).") from None
    if sha256 != results.actions_sha256:
        problems.append("the actions are not those that results.json was written with")
    if not problems:
        problems += _replay_all(results, actions, config.env_config, workers, report)
    episodes = sum(row.episodes for row in results.rows)
    found = VerifiedResults(episodes, tuple(problems), stated)
    if found.is_verified:
        record = {"sha256": stated, "episodes": episodes, "versions": versions(with_torch=False)}
        atomic_write_file(folder / VERIFICATION_NAME, json.dumps(record, indent=1) + "\n")
    return found


def is_marked_verified(path: Path) -> bool:
    """Whether `verify_results` has confirmed these results, with the actions that are beside them now.

    The mark of a folder that came from elsewhere is a claim.

    Args:
        path: Results, or the folder of an evaluation, which stands for its `results.json`.
    """
    folder = path if path.is_dir() else path.parent
    try:
        mark = read_json(folder / VERIFICATION_NAME)["sha256"]
        results, text = read_results(path)
        if _stated(results, text) != (mark, []):
            return False
        return read_actions(folder, results.rows)[1] == results.actions_sha256
    except (OSError, *MALFORMED):
        return False


def _stated(results: Results, text: str) -> tuple[str, list[str]]:
    """Return the digest that a file states, and what in it does not follow from the outcomes.

    That is any count, mean, interval, or the digest.
    """
    own_text, content = results.to_json(), json.loads(text)
    sha256, own = str(content.get("sha256", "")), json.loads(own_text)
    if text == own_text:
        return sha256, []
    differing = [key for key in own if content.get(key) != own[key] and key != "sha256"]
    if differing:
        return sha256, [f"{', '.join(differing)} do not follow from the outcomes"]
    return sha256, ["the file was edited after it was written: its digest differs"]


def _row_problems(results: Results, whole: EvaluationConfig) -> Iterator[str]:
    """Compare the rows with the settings: no task, level or seed is missing, added or doubled."""
    last = whole.seed + whole.episodes - 1
    played = group_by_key(((row.policy, row.ablation), (row.task, row.level)) for row in results.rows)
    for row in results.rows:
        if [outcome.seed for outcome in row.outcomes] != [*range(whole.seed, last + 1)]:
            yield f"{_named(row)} has other seeds than {whole.seed} to {last}"
    for (policy, ablation), found in played.items():
        if sorted(found) != sorted(cells(whole, ablation)):
            yield f"{echo(policy)} {echo(ablation)} has other tasks and levels than the settings"
    ablations = {ablation for _, ablation in played if ablation}
    if not {*whole.asked_ablations} <= ablations <= {*whole.all_ablations}:
        yield "the ablations of the rows are not those of the settings"
    named = {policy for policy, ablation in played if not ablation}
    if named != set(results.config["policies"]) or named != set(results.policies):
        yield "the policies of the rows are not those of the settings"


def _check_simulator(path: Path, found: Mapping[str, str]) -> None:
    own = versions(with_torch=False)
    for name in _SIMULATOR:
        if found.get(name) != own[name]:
            raise DatasetError(
                f"{path} was obtained with {name} {echo(str(found.get(name)))}; here is {own[name]}. "
                "Outcomes are confirmed with the same version only."
            )


def recorded_config(results: Results, assets: str | None = None) -> EvaluationConfig:
    """Return the settings of an evaluation, without its policies; assets are recorded without their path.

    Args:
        results: The results.
        assets: As for `verify_results`.

    Raises:
        AssetError: The results name a function as their assets, which is not run.
    """
    config = results.config
    env_config = EnvConfig.from_record(config)
    assets = recorded_assets(env_config.assets) if assets is None else assets
    return EvaluationConfig(
        (ORACLE,),
        (*config["tasks"],),
        (*config["levels"],),
        int(config["episodes"]),
        int(config["seed"]),
        env_config=replace(env_config, assets=assets),
        device=config.get("device", DEFAULT_DEVICE),
        precision=config.get("precision"),
        ablations=(*config.get("ablations", ()),),
        boxes=config.get("boxes"),
    )


def _replay_all(
    results: Results,
    actions: Sequence[Sequence[np.ndarray]],
    env_config: EnvConfig,
    workers: int,
    report: Report | None,
) -> list[str]:
    jobs = [
        _Replay(
            replace(row, outcomes=row.outcomes[first : first + _BATCH]),
            episodes[first : first + _BATCH],
            ablated_environment(row.ablation, env_config),
        )
        for row, episodes in zip(results.rows, actions, strict=True)
        for first in range(0, row.episodes, _BATCH)
    ]
    total = sum(row.episodes for row in results.rows)
    watch = None if report is None else (lambda done: report(done, total, "replaying"))
    problems = dict(imap_unordered(replay_episodes, jobs, workers, report=watch))
    return [problem for job in jobs for problem in problems[job]]


def replay_episodes(job: _Replay, count: Callable[[int], None]) -> list[str]:
    """Execute the actions of some episodes in a worker process; return what differs."""
    row = job.row
    envs = [job.env_config.make(row.task, row.level, domain="eval") for _ in row.outcomes]
    for env in envs:
        env.modalities = ("joints",)  # nothing is rendered
    seeds = [outcome.seed for outcome in row.outcomes]
    again = play(envs, seeds, ActionReplay(job.actions))
    count(len(again))
    return [
        f"{_named(row)}, seed {given.seed}, replayed: {difference}"
        for given, own in zip(row.outcomes, again, strict=True)
        if (difference := _difference(given, own))
    ]


def _difference(given: EpisodeOutcome, own: EpisodeOutcome) -> str:
    """Name what differs between a recorded and a replayed outcome."""
    if own.kind == NO_ORACLE_ACTION and given.kind.startswith(_ENDED_EARLY):
        own = replace(own, kind=given.kind, reason=given.reason)
    own = replace(own, near_ties=given.near_ties)
    return ", ".join(differences(asdict(given), asdict(own)))


def _named(row: Row) -> str:
    ablation = f" ({row.ablation})" if row.ablation else ""
    return echo(f"{row.policy}{ablation}, {row.task}, {row.level}")
