"""Running an evaluation: batches of episodes in worker processes, each stored as it finishes.

`score` evaluates policy objects in this process, and stores nothing.
"""

import json
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from openvima.atomic_io import FINISH_S, Part, atomic_write_file, folder_lock, parts_in_range
from openvima.catalog.packs import load_assets
from openvima.detector.plugins import plugged_boxes
from openvima.env.config import EnvConfig
from openvima.errors import ConfigError, differences, echo, one_word_warning
from openvima.evaluation.ablations import NOISY_BOXES
from openvima.evaluation.actions import write_actions
from openvima.evaluation.chat import Said, summarise, write_answers
from openvima.evaluation.config import DEFAULT_EPISODES, Batch, EvaluationConfig, plan
from openvima.evaluation.results import FILE_NAME, EpisodeOutcome, Results, Row, versions
from openvima.evaluation.rollout import PlayedEpisode, roll_out
from openvima.evaluation.rollout_policies import (
    PromptedRolloutPolicy,
    VlmRolloutPolicy,
    build_policy,
    load_rollout_policy,
    one_thread,
)
from openvima.evaluation.sources import object_record
from openvima.input_files import MALFORMED, names_of
from openvima.multiprocess import Report, imap_with_engine
from openvima.policies.base import Policy
from openvima.policies.naming import PolicyRef
from openvima.scene.action import PRIMITIVES, steps_per_primitive
from openvima.serving.chat import VlmPolicy
from openvima.tasks.registry import task_spec
from openvima.user_code import is_code, source_hash
from openvima.video.encoder import FOLDER

LOG_NAME = "evaluation_log.json"
_PARTS = "parts"
_ANSWERS = "answers"  # in the record of a policy: what is known once it was played


@dataclass(frozen=True, slots=True)
class PreparedEvaluation:
    """An evaluation whose names are checked.

    Args:
        config: What to evaluate.
        batches: The batches of episodes.
        results: Results without rows: settings, versions, and what each policy is.
    """

    config: EvaluationConfig
    batches: tuple[Batch, ...]
    results: Results


Played = dict[Batch, list[PlayedEpisode]]


def evaluate(config: EvaluationConfig, report: Report | None = None) -> Path:
    """Score policies on tasks and levels.

    Outcomes of finished batches are kept below `config.out` until all are there, so an interrupted evaluation
    goes on where it stopped. If the folder holds the results of the same evaluation, nothing is played again.

    Args:
        config: What to evaluate.
        report: Called with episodes done, episodes in all and a note on the last batch.

    Returns:
        `results.json` in `config.out`. `openvima.report` adds videos and a page.

    Raises:
        UnknownPolicyError: There is no policy of a name; nothing was loaded, downloaded or played by then.
        ConfigError: The settings or an address cannot be, or `config.out` holds results of other settings.
        MissingExtraError: An optional dependency (torch, Ray) is not installed.
        WorkerError: A worker process died; what was finished is kept.
        FolderLockedError: Another evaluation writes to `config.out`.
    """
    with config.served() as served:
        prepared = prepare(served)
        with folder_lock(config.out):
            return evaluate_prepared(prepared, report)


def evaluate_range(config: EvaluationConfig, shards: Part, report: Report | None = None) -> bool:
    """Play some of the batches of an evaluation, for job arrays that share `config.out`.

    Args:
        config: What to evaluate, equal in all jobs.
        shards: First and past-the-end position in `plan(config)` of the batches to play.
        report: As for `evaluate`.

    Returns:
        Whether this was the last job, which has written `results.json`.

    Raises:
        ConfigError: There is no such batch, `force` is set, or as for `evaluate`.
        FolderLockedError: Another job plays some of these batches.
        OpenVimaError: As for `evaluate`.
    """
    if config.force:
        raise ConfigError(
            "force and shard_range exclude each other: each job would delete the results of others."
        )
    with config.served() as served:
        prepared = prepare(served)
        own = replace(prepared, batches=tuple(parts_in_range(prepared.batches, shards)))
        path = config.out / FILE_NAME
        with folder_lock(config.out, shards):
            if _earlier(path, prepared) is None:
                _play_all(own, report)
        if len(_read_finished(prepared)) < len(prepared.batches):
            return False
        with folder_lock(config.out, timeout_s=FINISH_S):  # others may have come to the same conclusion
            if path.exists():
                return False
            evaluate_prepared(prepared)
            return True


def prepare(config: EvaluationConfig) -> PreparedEvaluation:
    """Check the names of policies and detector, before any episode and any file.

    Raises:
        OpenVimaError: As for `evaluate`.
    """
    for source in config.sources:
        source.check(trust_code=config.trust_code)
    boxes = "" if config.boxes is None else plugged_boxes(config.boxes).name
    batches, assets = plan(config), config.env_config.assets
    policies = {source.name: source.record(config.vlm) for source in config.sources}
    found = versions(
        with_torch=any(what["kind"] in ("run", "untrained", "code") for what in policies.values())
    )
    code = [found, source_hash(assets, what="assets") if is_code(assets) else ""]
    prints = {name: json.dumps([what, *code], sort_keys=True) for name, what in policies.items()}
    known = (
        replace(batch, fingerprint=prints[batch.policy] + (boxes if batch.boxes else "")) for batch in batches
    )
    record = config.record() | ({"boxes_code": boxes} if boxes else {})
    return PreparedEvaluation(config, tuple(known), Results((), record, found, policies))


def evaluate_prepared(prepared: PreparedEvaluation, report: Report | None = None) -> Path:
    """Evaluate into a folder whose lock is held; see `evaluate`."""
    config = prepared.config
    path = config.out / FILE_NAME
    results = _earlier(path, prepared)
    if results is None:
        load_assets(config.env_config.assets)  # an unfit pack is named before anything is written
        started = time.perf_counter()
        played = _play_all(prepared, report)
        episodes = ((each.outcome.seed, each.actions) for batch in played.values() for each in batch)
        digest = write_actions(config.out, episodes, control=config.env_config.control)
        policies, median_s = _add_answers(prepared, played)
        rows = _join_rows(played)
        results = replace(prepared.results, rows=rows, policies=policies, actions_sha256=digest)
        results.write(path)
        _write_log(config, results, time.perf_counter() - started, median_s)
    shutil.rmtree(config.out / _PARTS, ignore_errors=True)
    return path


def finished_part(config: EvaluationConfig) -> Results | None:
    """Return the results of the tasks and levels whose episodes are all finished; None without any."""
    prepared = prepare(config)
    finished = _read_finished(prepared)
    unfinished = {batch.cell for batch in prepared.batches if batch not in finished}
    rows = _join_rows({batch: played for batch, played in finished.items() if batch.cell not in unfinished})
    return replace(prepared.results, rows=rows) if rows else None


def _join_rows(played: Played) -> tuple[Row, ...]:
    """Join the batches of each policy, ablation, task and level; they are given in their order."""
    rows = []
    for (policy, ablation, task, level), group in groupby(played, key=lambda batch: batch.cell):
        batches = list(group)
        max_steps = task_spec(task).oracle_max_steps * steps_per_primitive(batches[0].env_config.control)
        outcomes = tuple(episode.outcome for batch in batches for episode in played[batch])
        rows.append(Row(policy, task, level, max_steps, outcomes, ablation))
    return tuple(rows)


def _add_answers(
    prepared: PreparedEvaluation, played: Played
) -> tuple[dict[str, dict[str, Any]], float | None]:
    """Write what models said; return the records of the policies with its summary, and a median time."""
    policies, steps = dict(prepared.results.policies), []
    episodes: dict[str, list[tuple[EpisodeOutcome, Said]]] = {}
    for batch, of_batch in played.items():
        where = {name: getattr(batch, name) for name in ("policy", "task", "level", "ablation")}
        for episode in of_batch:
            if episode.said is not None:
                at = where | {"seed": episode.outcome.seed}
                episodes.setdefault(batch.policy, []).append((episode.outcome, episode.said))
                steps += [at | {"step": n} | step for n, step in enumerate(episode.said)]
    for name, of_policy in episodes.items():
        policies[name] = {**policies[name], _ANSWERS: summarise(of_policy)}
    return policies, write_answers(prepared.config.out, steps)


def _earlier(path: Path, prepared: PreparedEvaluation) -> Results | None:
    """Results of the same evaluation that are there already, if any."""
    if not path.exists() or prepared.config.force:
        return None
    earlier = Results.read(path)
    differing = differences(_collect_settings(earlier), _collect_settings(prepared.results))
    if not differing:
        return earlier
    raise ConfigError(
        f"{path} holds another evaluation: {'; '.join(differing)}. Choose another --out, or give --force to "
        "overwrite it."
    )


def _collect_settings(results: Results) -> dict[str, object]:
    """Return what the outcomes depend on."""
    policies = {
        name: {key: value for key, value in what.items() if key != _ANSWERS}
        for name, what in results.policies.items()
    }
    return results.config | {"policies": policies, "versions": results.versions}


def _play_all(prepared: PreparedEvaluation, report: Report | None) -> Played:
    """Run the batches that are not finished yet; return all, in their order."""
    config, batches = prepared.config, prepared.batches
    (config.out / _PARTS).mkdir(parents=True, exist_ok=True)
    shutil.rmtree(config.out / FOLDER, ignore_errors=True)  # videos of other results
    finished = _read_finished(prepared)
    total, done = sum(batch.episodes for batch in batches), sum(batch.episodes for batch in finished)
    if report is not None:
        report(done, total, "")
    first = {batch.policy: batch for batch in reversed(batches)}
    missing = [
        replace(batch, may_fail=batch is not first[batch.policy])
        for batch in batches
        if batch not in finished
    ]
    for batch, played in _play_missing(config, missing):
        content = {"episodes": [asdict(episode) for episode in played]}
        atomic_write_file(_part(batch, config), json.dumps(content, ensure_ascii=False) + "\n")
        finished[batch] = played
        done += batch.episodes
        if report is not None:
            report(done, total, " ".join(filter(None, batch.cell)))
    return {batch: finished[batch] for batch in batches}


def _part(batch: Batch, config: EvaluationConfig) -> Path:
    """Where the episodes of a batch are kept until all are there."""
    return config.out / _PARTS / f"{batch.key}.json"


def _read_finished(prepared: PreparedEvaluation) -> Played:
    """Return the batches of an interrupted run; parts that cannot be used are left out."""
    finished: Played = {}
    for batch in prepared.batches:
        with suppress(OSError, *MALFORMED):
            record = json.loads(_part(batch, prepared.config).read_text(encoding="utf-8"))
            finished[batch] = [
                PlayedEpisode(EpisodeOutcome(**episode["outcome"]), episode["actions"], episode["said"])
                for episode in record["episodes"]
            ]
    return finished


def _play_missing(
    config: EvaluationConfig, batches: list[Batch]
) -> Iterator[tuple[Batch, list[PlayedEpisode]]]:
    """Run batches on the configured engine and yield them as they finish."""
    chats = [batch for batch in batches if PolicyRef.parse(batch.source).kind == "vlm"]
    others = [batch for batch in batches if batch not in chats]
    yield from _play_chats(chats, config.vlm.options.concurrency)
    if others:  # else no cluster is needed
        yield from imap_with_engine(config.engine, play_batch, others, config.workers, address=config.address)


def _play_chats(batches: Sequence[Batch], num_threads: int) -> Iterator[tuple[Batch, list[PlayedEpisode]]]:
    """Play the episodes of vision-language models in threads of this process: they wait for a server.

    Episodes of all batches overlap, so that the end of one leaves no request unused. Where it is stopped, the
    answers that are on their way are waited for, and kept.
    """
    by_source = {batch.source: batch for batch in batches}
    policies = {
        source: build_policy(source, boxes=one.boxes, vlm=one.vlm) for source, one in by_source.items()
    }
    with ThreadPoolExecutor(num_threads) as pool:
        playing = [
            (batch, [pool.submit(_play_chat, batch, policies[batch.source], seed) for seed in batch.seeds])
            for batch in batches
        ]
        try:
            for batch, episodes in playing:
                yield batch, [episode.result() for episode in episodes]
        except BaseException:
            for policy in policies.values():
                policy.client.is_stopped = True
            pool.shutdown(cancel_futures=True)
            raise


def _play_chat(batch: Batch, policy: VlmPolicy, seed: int) -> PlayedEpisode:
    chat = VlmRolloutPolicy(policy.new_session(), batch.ablation, name=batch.policy)
    with policy.client.turn:
        (played,) = roll_out([batch.make_env()], [seed], chat, may_fail=batch.may_fail)
    return replace(played, said=chat.said[0])


def play_batch(batch: Batch, count: Callable[[int], None]) -> list[PlayedEpisode]:
    """Run one batch in a worker process, possibly on another machine."""
    with one_thread(batch):
        envs = [batch.make_env() for _ in batch.seeds]
        played = roll_out(envs, batch.seeds, load_rollout_policy(batch), may_fail=batch.may_fail)
    count(len(played))
    return played


def _write_log(
    config: EvaluationConfig, results: Results, seconds: float, median_answer_s: float | None
) -> None:
    """Write what depends on the machine and the time, apart from the results."""
    episodes = sum(row.episodes for row in results.rows)
    record = {
        "episodes": episodes,
        "seconds": round(seconds, 3),
        "engine": config.engine,
        "workers": config.workers,
        "policies": {source.name: source.source for source in config.sources},
        **({} if median_answer_s is None else {"median_answer_s": median_answer_s}),
    }
    atomic_write_file(config.out / LOG_NAME, json.dumps(record, indent=1) + "\n")


def score(
    policies: Mapping[str, Policy],
    *,
    tasks: str | Sequence[str] = ("all",),
    levels: str | Sequence[str] = ("L1", "L2", "L3", "L4"),
    episodes: int = DEFAULT_EPISODES,
    seed: int = 0,
    ablations: str | Sequence[str] = (),
    prompts: str = "multimodal",
    task_options: str = "",
    control: str = PRIMITIVES,
) -> Results:
    """Evaluate policy objects on the episodes of `openvima evaluate`.

    Args:
        policies: Objects that implement the `Policy` protocol, by their names in the results.
        tasks: Names of tasks, or "all" for every task that the level holds.
        levels: From `openvima.catalog.LEVELS`.
        episodes: Episodes for each policy, task and level.
        seed: First seed, of domain "eval"; the others follow without gaps.
        ablations: Input ablations, as in `EvaluationConfig`, except for "detected_boxes"; "noisy_boxes" for
            `NetworkPolicy` only.
        prompts: "multimodal", "text" or "mixed", see `openvima.make`; such as "text" for a policy that reads
            language alone.
        task_options: As in `EnvConfig`, such as "num_distractors=3".
        control: "primitives" or "end_effector"; that of all the policies.

    Returns:
        Success rates and the outcome of every episode. One in which the policy raises has failed;
        `Results.policy_errors` counts them.

    Raises:
        UnknownTaskError: There is no such task.
        ConfigError: There is no such level, or none of the levels holds a task that was named.
        ConfigError: There is no episode, or the name of a policy, a task option or an ablation does not fit.
        PolicyError: A policy lacks a method, or never acts in its first batch: it raises, or gives something
            else than an action for each episode.

    Example:
        >>> from openvima.policies import RandomPolicy
        >>> score({"random": RandomPolicy()}, tasks=("rotate",), levels=("L1",), episodes=2).rows[0].episodes
        2
    """
    config = EvaluationConfig(
        tuple(policies),
        tasks=names_of(tasks),
        levels=names_of(levels),
        episodes=episodes,
        seed=seed,
        env_config=EnvConfig(prompts=prompts, task_options=task_options, control=control),
        ablations=names_of(ablations),
    )
    if wrong := set(policies) - {source.name for source in config.sources}:
        raise ConfigError(
            f"policy {echo(repr(min(wrong)))}: names are of letters, digits, dots, hyphens and underscores."
        )
    if config.uses(NOISY_BOXES) and (own := [n for n, p in policies.items() if not hasattr(p, "processor")]):
        raise ConfigError(
            f"policy {', '.join(own)} extracts objects by code of its own, which the ablation {NOISY_BOXES} "
            "does not reach; leave it out."
        )
    played: Played = {}
    begun: set[str] = set()
    with one_word_warning():
        for batch in plan(config):
            envs = [batch.make_env() for _ in batch.seeds]
            given = policies.get(batch.policy)
            rollout_policy = (
                load_rollout_policy(batch)
                if given is None
                else PromptedRolloutPolicy(given, batch.ablation, name=batch.policy)
            )
            may_fail = batch.policy in begun  # a policy that fails from the start is an error, no result
            played[batch] = roll_out(envs, batch.seeds, rollout_policy, may_fail=may_fail)
            begun.add(batch.policy)
    kinds = {
        source.name: {"kind": "object", **object_record(policies[source.name])}
        if source.name in policies
        else source.record()
        for source in config.sources
    }
    return Results(_join_rows(played), config.record(), versions(with_torch=True), kinds)
