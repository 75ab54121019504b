"""Scoring policies of your own: objects with `reset` and `act`, played in this process."""

from collections.abc import Mapping

from openvima.evaluation.players import PolicyPlayer
from openvima.evaluation.protocol import DEFAULT_EPISODES, EvaluationConfig, plan
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.rollout import play
from openvima.evaluation.versions import versions
from openvima.policies.base import Policy
from openvima.tasks.registry import task_spec


def score(
    policies: Mapping[str, Policy],
    *,
    tasks: tuple[str, ...] = ("all",),
    levels: tuple[str, ...] = ("L1", "L2", "L3", "L4"),
    episodes: int = DEFAULT_EPISODES,
    seed: int = 0,
) -> Results:
    """Play the episodes of `openvima evaluate` with policies that exist as objects only.

    Args:
        policies: Anything that fulfils the `Policy` protocol, by the name that it bears in the results.
        tasks: Names of tasks, or ("all",) for every task that the level holds.
        levels: From "train", "L1", "L2", "L3", "L4".
        episodes: Episodes for each policy, task and level.
        seed: First seed, of domain "eval"; the others follow without gaps.

    Returns:
        Success rates and the outcome of every episode.

    Raises:
        UnknownTaskError: There is no such task.
        LevelError: There is no such level, or none of the levels holds a task that was named.
        ConfigError: There is nothing to play.
        PolicyError: A policy left out an episode that is not over.

    Example:
        >>> from openvima.policies import RandomPolicy
        >>> score({"random": RandomPolicy()}, tasks=("rotate",), levels=("L1",), episodes=2).rows[0].episodes
        2
    """
    config = EvaluationConfig(
        tuple(policies), tasks=tasks, levels=levels, episodes=episodes, seed=seed, report=False
    )
    outcomes: dict[tuple[str, str, str], list[EpisodeOutcome]] = {}
    for batch in plan(config):
        envs = [batch.setup.make(batch.task, batch.level, domain="eval") for _ in batch.seeds]
        played = play(envs, batch.seeds, PolicyPlayer(policies[batch.policy]))
        outcomes.setdefault((batch.policy, batch.task, batch.level), []).extend(played)
    rows = tuple(
        Row(policy, task, level, task_spec(task).oracle_max_steps, tuple(cell))
        for (policy, task, level), cell in outcomes.items()
    )
    kinds = {name: {"kind": "object"} for name in policies}
    return Results(rows, config.record(), versions(with_torch=True), kinds)
