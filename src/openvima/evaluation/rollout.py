"""Rollouts of a batch of episodes: environments step together, with batched inference."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from openvima.env.tabletop import TabletopEnv
from openvima.errors import (
    ActionError,
    AnswerError,
    OpenVimaError,
    OracleError,
    PolicyError,
    PolicyRaisedError,
    PromptError,
    ShapeError,
)
from openvima.evaluation.actions import Steps, numbers_of
from openvima.evaluation.chat import Said
from openvima.evaluation.results import BAD_ACTION, POLICY_ERROR, EpisodeOutcome, failure_kind
from openvima.evaluation.rollout_policies import Decision, RolloutPolicy
from openvima.imports import lacks_memory
from openvima.scene import Episode
from openvima.scene.goal import object_of

NOTHING_PICKED = "nothing was picked up within the step limit"
WRONG_PICKED = "only wrong objects were picked up within the step limit"
NO_GOALS = "the step limit is reached; the episode has no goals"
OUT_OF_STEPS = "not done within the step limit"
NO_ORACLE_ACTION = "the oracle has no action"
# What one prompt or observation may cause, unlike a lost server or a missing package.
_OF_EPISODES = (PolicyError, PromptError, ShapeError, ActionError)


@dataclass(frozen=True, slots=True)
class PlayedEpisode:
    """How an episode ended, its executed actions, and what a language model said in each step."""

    outcome: EpisodeOutcome
    actions: Steps
    said: Said | None = None


class EpisodeSlot:
    """One environment of a batch and the state of its episode.

    Args:
        env: The environment; it is reset.
        start: The episode, or its seed.
        after_step: Called with the environment after each step.
    """

    def __init__(
        self,
        env: TabletopEnv,
        start: int | Episode,
        after_step: Callable[[TabletopEnv], None] = lambda env: None,
    ) -> None:
        self.env = env
        self.after_step = after_step
        self.actions: Steps = []
        self.grasped: set[int] = set()
        self.near_ties = 0
        self.outcome: EpisodeOutcome | None = None
        self.observation: dict[str, Any] | None = begin_episode(env, start)  # None once the episode is over

    def step(self, decision: Decision) -> None:
        """Take one step, unless there is no usable action; then the episode has failed."""
        if isinstance(decision, OracleError):
            return self.end(str(decision), NO_ORACLE_ACTION)
        if isinstance(decision, AnswerError):
            return self.end(str(decision), decision.kind)
        assert decision is not None  # rollout policies have checked it
        try:
            _, terminated, truncated, info = self.env.advance(decision)
        except ActionError as error:
            return self.end(str(error), BAD_ACTION)
        self.actions.append(numbers_of(decision, self.env.control))
        self.after_step(self.env)
        self.grasped |= {info["grasped"]} - {0}
        if info["success"]:
            self.end()
        elif terminated:
            self.end(info["reason"], failure_kind(info["reason"]))
        elif truncated:
            self.end(*self._why_not_done(info["end_effector"] == "suction"))
        else:
            self.observation = self.env.observe()
        return None

    def _why_not_done(self, picks: bool) -> tuple[str, str]:
        """Say what was lacking at the end of the steps, with numbers and without."""
        if not self.env.episode.problem.goals:
            return NO_GOALS, NO_GOALS
        if picks and not self.grasped:
            return NOTHING_PICKED, NOTHING_PICKED
        problem = self.env.episode.problem
        right = {object_of(goal) for goal in (*problem.goals, *problem.prerequisites)}
        if picks and None not in right and not self.grasped & right:
            return WRONG_PICKED, WRONG_PICKED
        num_met = len(problem.goals) - len(self.env.progress.open_goals)
        needed = problem.num_required or len(problem.goals)
        return f"{OUT_OF_STEPS}: {num_met} of {needed} goals were met", OUT_OF_STEPS

    def end(self, reason: str = "", kind: str = "") -> None:
        """End the episode, as a failure if there is a reason."""
        episode, self.observation = self.env.episode, None
        self.outcome = EpisodeOutcome(
            episode.seed,
            not kind,
            len(self.actions),
            reason,
            kind,
            resamples=episode.num_redraws,
            oracle_max_steps=self.env.oracle_max_steps,
            near_ties=self.near_ties,
        )


def begin_episode(env: TabletopEnv, start: int | Episode) -> dict[str, Any]:
    """Reset an environment to an episode or the number of one, and return the first observation."""
    if isinstance(start, Episode):
        return env.reset(options={"episode": start})[0]
    return env.reset(seed=start)[0]


def play(
    envs: Sequence[TabletopEnv],
    starts: Sequence[int | Episode],
    policy: RolloutPolicy,
    **options: Any,
) -> list[EpisodeOutcome]:
    """Play one episode in each environment, as `roll_out` does, and return how each ended."""
    return [played.outcome for played in roll_out(envs, starts, policy, **options)]


def roll_out(
    envs: Sequence[TabletopEnv],
    starts: Sequence[int | Episode],
    policy: RolloutPolicy,
    *,
    after_step: Callable[[TabletopEnv], None] = lambda env: None,
    may_fail: bool = False,
) -> list[PlayedEpisode]:
    """Play one episode in each environment.

    Where the policy raises, the episodes that are not over are played again one by one, from their starts;
    those in which it raises again have failed.

    Args:
        envs: Environments of one task and level.
        starts: Seed of the episode of each, or the episode.
        policy: Decides the actions; its `modalities` become those of the environments.
        after_step: Called with an environment after each of its steps, for recording; an action that is
            refused is no step.
        may_fail: The policy may raise before the first action of every episode.

    Returns:
        The episodes, in the order of `starts`.

    Raises:
        PolicyError: The policy raised before the first action of every episode, or cannot act in so many
            episodes at once.
    """
    if (modalities := getattr(policy, "modalities", None)) is not None:
        for env in envs:
            env.modalities = modalities
    slots = [EpisodeSlot(env, start, after_step) for env, start in zip(envs, starts, strict=True)]
    error = _play_together(slots, policy)
    if error is None:
        return _collect_played(slots)
    running = [index for index, slot in enumerate(slots) if slot.outcome is None]
    if len(running) == 1:
        slots[running[0]].end(str(error), POLICY_ERROR)
    else:
        for index in running:
            slots[index] = EpisodeSlot(envs[index], starts[index], after_step)
            if (own := _play_together([slots[index]], policy)) is not None:
                slots[index].end(str(own), POLICY_ERROR)
    played = _collect_played(slots)
    failed = [episode for episode in played if episode.outcome.kind == POLICY_ERROR]
    is_of_batch = not isinstance(error, PolicyRaisedError) and not failed
    never_acts = len(failed) == len(played) and not any(episode.actions for episode in failed)
    if is_of_batch or (never_acts and not may_fail):
        raise error
    return played


def _collect_played(slots: Sequence[EpisodeSlot]) -> list[PlayedEpisode]:
    return [PlayedEpisode(slot.outcome, slot.actions) for slot in slots if slot.outcome is not None]


def _play_together(slots: Sequence[EpisodeSlot], policy: RolloutPolicy) -> OpenVimaError | None:
    """Step all environments until every episode is over; return the error of the policy before that."""
    has_begun = False
    while any(slot.outcome is None for slot in slots):
        try:
            if not has_begun:
                policy.begin([slot.env for slot in slots])
                has_begun = True
            decisions = policy.decide([slot.observation for slot in slots])
        except _OF_EPISODES as error:
            if lacks_memory(error):
                raise
            return error
        near_ties = getattr(policy, "near_ties", ()) or [False] * len(slots)
        for slot, decision, is_near_tie in zip(slots, decisions, near_ties, strict=True):
            if slot.outcome is None:
                slot.near_ties += is_near_tie
                slot.step(decision)
    return None
