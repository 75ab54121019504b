"""Evaluating policy objects with `reset` and `act` in this process."""

from collections.abc import Mapping, Sequence

from openvima.env.config import EnvConfig
from openvima.errors import ConfigError, PolicyError, echo
from openvima.evaluation.ablations import NOISY_BOXES
from openvima.evaluation.config import DEFAULT_EPISODES, Batch, EvaluationConfig, plan, rows_of
from openvima.evaluation.results import EpisodeOutcome, Results
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy, load_rollout_policy
from openvima.evaluation.sources import object_record
from openvima.evaluation.versions import versions
from openvima.input_files import names_of
from openvima.policies.base import Policy
from openvima.scene.action import PRIMITIVES


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
        levels: From "train", "L1", "L2", "L3", "L4".
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
        LevelError: There is no such level, or none of the levels holds a task that was named.
        ConfigError: There is no episode, or the name of a policy, a task option or an ablation does not fit.
        PolicyError: A policy lacks a method, or never acts in its first batch: it raises, or gives something
            else than an action for each episode.

    Example:
        >>> from openvima.policies import RandomPolicy
        >>> score({"random": RandomPolicy()}, tasks=("rotate",), levels=("L1",), episodes=2).rows[0].episodes
        2
    """
    if not isinstance(policies, Mapping):
        raise PolicyError(
            f"policies is a {type(policies).__name__}; give policies by name, as {{'mine': …}}."
        )
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
    batches = plan(config)
    outcomes: dict[Batch, tuple[EpisodeOutcome, ...]] = {}
    begun: set[str] = set()
    for batch in batches:
        envs = [batch.env_config.make(batch.task, batch.level, domain="eval") for _ in batch.seeds]
        given = policies.get(batch.policy)
        rollout_policy = (
            load_rollout_policy(batch)
            if given is None
            else PromptedRolloutPolicy(given, batch.ablation, name=batch.policy)
        )
        may_fail = batch.policy in begun  # a policy that fails from the start is an error, no result
        outcomes[batch] = tuple(play(envs, batch.seeds, rollout_policy, may_fail=may_fail))
        begun.add(batch.policy)
    kinds = {
        source.name: {"kind": "object", **object_record(policies[source.name])}
        if source.name in policies
        else source.record()
        for source in config.sources
    }
    return Results(rows_of(batches, outcomes), config.record(), versions(with_torch=True), kinds)
