"""Episodes that are stepped, taken back and inspected; the studio and `play` are made of them."""

import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from openvima.catalog import Assets
from openvima.env.episode_file import load_episode
from openvima.env.tabletop import TabletopEnv, VideoFrame
from openvima.errors import (
    AnswerError,
    ConfigError,
    EpisodeError,
    OpenVimaError,
    OracleError,
    PolicyError,
    brief_repr,
)
from openvima.evaluation.config import DEFAULT_DEVICE
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout import EpisodeSlot
from openvima.evaluation.rollout_policies import (
    Decision,
    RolloutPolicy,
    as_rollout_policy,
    explainer_of,
    load_own_rollout_policy,
)
from openvima.evaluation.sources import ORACLE
from openvima.input_files import as_path
from openvima.policies.base import Policy
from openvima.render.rasteriser import Rasteriser, front_above_top
from openvima.scene import HOST_TASK, Action, Episode, Outcome, RenderedPrompt, Scene
from openvima.scene.explanation import Explanation
from openvima.tasks.oracle import require_goals
from openvima.user_code import described
from openvima.video.recorder import EpisodeRecorder

SAME_POSITION_M, SAME_YAW_RAD = 0.02, math.radians(10)  # actions that differ by less count as equal


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """What the policy would do next.

    Args:
        action: Its action; None if there is no policy, or it gave none.
        explanation: What it considered, for policies that explain.
        error: Why there is no action, or no explanation.
        decision: What the policy gave, also where it is no valid action.
    """

    action: Action | None = None
    explanation: Explanation | None = None
    error: OpenVimaError | None = None
    decision: Decision = field(default=None, repr=False)

    __repr__ = brief_repr


@dataclass(frozen=True, slots=True, eq=False)
class SessionStep:
    """One executed step.

    Args:
        action: The action.
        proposal: What the policy proposed; its action is another one where a user acted.
        scene: The scene after the step.
        frames: Scenes and joint angles while it ran, 30 a second, if the session records them.
    """

    action: Action
    proposal: Proposal
    scene: Scene
    frames: tuple[VideoFrame, ...] = field(repr=False)

    __repr__ = brief_repr


class EpisodeSession:
    """An episode, a policy and the steps taken so far.

    The policy is asked at every step, also where a user acts, so that its history is whole. What it raises is
    a value, `Proposal.error`, and leaves the session usable.

    Args:
        episode: The episode, sampled or composed.
        policy: Decides where `step` is given no action; None: a user acts.
        assets: Asset pack.
        compat: Reproduce VIMA-Bench's quirks.
        record: Whether steps record frames, for videos and the studio.
        explain: Whether to ask the policy for explanations.

    Example:
        >>> from openvima.evaluation.rollout_policies import OracleRolloutPolicy
        >>> from openvima.tasks import sample_episode
        >>> session = EpisodeSession(sample_episode("rotate", seed=0), OracleRolloutPolicy())
        >>> step = session.step()
        >>> session.outcome.success
        True
        >>> session.back(0)
        >>> session.num_steps
        0
    """

    def __init__(
        self,
        episode: Episode,
        policy: Policy | RolloutPolicy | None = None,
        *,
        assets: str | Path | Assets = "procedural",
        compat: bool = False,
        record: bool = True,
        explain: bool = True,
    ) -> None:
        self.episode = episode
        self.env = TabletopEnv(HOST_TASK, assets=assets, compat=compat, realtime=record)
        self._policy = None if policy is None else as_rollout_policy(policy)
        self._record, self._explains = record, explain
        self.steps: list[SessionStep] = []
        self._restart()

    @property
    def num_steps(self) -> int:
        """Number of steps taken."""
        return len(self.steps)

    @property
    def outcome(self) -> EpisodeOutcome | None:
        """How the episode ended; None while it runs."""
        return self._slot.outcome

    @property
    def scene(self) -> Scene:
        """The current scene."""
        return self.env.scene

    @property
    def prompt(self) -> RenderedPrompt:
        """The prompt, with its images."""
        return self.env.prompt

    @property
    def policy(self) -> RolloutPolicy | None:
        """The policy; one that is assigned reads the steps so far and decides the next."""
        return self._policy

    @policy.setter
    def policy(self, policy: Policy | RolloutPolicy | None) -> None:
        self._policy = None if policy is None else as_rollout_policy(policy)
        self.back(self.num_steps)

    def summary(self) -> str:
        """Say in a phrase how far the episode is, or how it ended."""
        taken = "1 step" if self.num_steps == 1 else f"{self.num_steps} steps"
        if self.outcome is None:
            return f"{taken} of at most {self.episode.max_steps}"
        return (
            f"solved in {taken}" if self.outcome.success else f"not solved ({taken}): {self.outcome.reason}"
        )

    def frame(self) -> VideoFrame:
        """Return the current scene with the arm's joint angles, for drawing."""
        return VideoFrame(self.scene, self.env.joints)

    def propose(self) -> Proposal:
        """Ask the policy what it would do next; it is asked once a step."""
        if self._proposal is None:
            self._proposal = self._ask(explain=self._explains)
        return self._proposal

    def step(self, action: Action | None = None) -> SessionStep | None:
        """Take a step.

        Args:
            action: The action of a user; None: that of the policy.

        Returns:
            The step; None if nothing was executed, as `propose` explains.

        Raises:
            EpisodeError: The episode is over.
            ActionError: The given action is invalid; nothing was moved.
        """
        if self.outcome is not None:
            raise EpisodeError(f"the episode ended at step {self.num_steps}; go back, or start another.")
        checked = None if action is None else Action.from_arrays(action.to_arrays())
        proposal = self.propose()
        decision = checked or proposal.decision
        if decision is None:
            return None
        self._slot.step(decision)
        if len(self._slot.actions) == self.num_steps:  # not executed: the policy's action is invalid
            return None
        done = checked or proposal.action
        assert done is not None  # as executed
        step = SessionStep(done, proposal, self.scene, self.env.frames)
        self.steps.append(step)
        self._proposal = None
        return step

    def run(self, after_step: Callable[[TabletopEnv], None] = lambda env: None) -> EpisodeOutcome | None:
        """Step until the episode is over, or the policy gives no action; call a function after each step."""
        while self.outcome is None and self.step() is not None:
            after_step(self.env)
        return self.outcome

    def back(self, num_steps: int) -> None:
        """Go back to the state after some steps, by replaying their actions: the simulation is deterministic.

        Args:
            num_steps: How many of the steps to keep.

        Raises:
            EpisodeError: There are not so many steps.
        """
        if not 0 <= num_steps <= self.num_steps:
            raise EpisodeError(f"num_steps is {num_steps}; the episode has taken {self.num_steps}.")
        kept = self.steps[:num_steps]
        self._restart()
        self.env.realtime = False  # the frames are known
        for step in kept:
            self._ask(explain=False)
            self._slot.step(step.action)
        self.env.realtime = self._record
        self.steps = kept

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def _restart(self) -> None:
        if modalities := getattr(self._policy, "modalities", None):
            self.env.modalities = modalities
        self._slot = EpisodeSlot(self.env, self.episode)
        self.steps = []
        self._proposal: Proposal | None = None
        self._begun = False

    def _ask(self, *, explain: bool) -> Proposal:
        """Ask the policy."""
        if self._policy is None or self.outcome is not None:
            return Proposal()
        action, decision = None, None
        try:
            if not self._begun:
                self._policy.begin([self.env])
                self._begun = True
            (decision,) = self._policy.decide([self._slot.observation])
            if isinstance(decision, OracleError | AnswerError):
                return Proposal(error=decision, decision=decision)
            given: Any = decision  # of an action: a policy of the other control is refused
            action = given if isinstance(given, Action) else Action.from_arrays(given)
            explainer = explainer_of(self._policy) if explain else None
            return Proposal(action, explainer and explainer(), decision=decision)
        except OpenVimaError as error:
            return Proposal(action, error=error, decision=decision)
        except Exception as error:  # of the policy's own `explain`
            raised = PolicyError(f"the policy raised {described(error)}.")
            return Proposal(action, error=raised, decision=decision)


def first_difference(first: Sequence[SessionStep], second: Sequence[SessionStep]) -> int | None:
    """Return the index of the first step at which two runs of an episode differ.

    Positions that are farther apart than `SAME_POSITION_M` differ, and rotations than `SAME_YAW_RAD`.

    Args:
        first: Steps of one session.
        second: Steps of the other.

    Returns:
        Index of the step; None if the steps that both have taken are equal.
    """
    for index, (one, other) in enumerate(zip(first, second, strict=False)):
        far = max(
            math.dist(one.action.pose0_position, other.action.pose0_position),
            math.dist(one.action.pose1_position, other.action.pose1_position),
        )
        turned = _rotation(one.action) - _rotation(other.action)
        if far > SAME_POSITION_M or abs(math.remainder(turned, 2 * math.pi)) > SAME_YAW_RAD:
            return index
    return None


def _rotation(action: Action) -> float:
    return action.yaw1_rad - action.yaw0_rad


@dataclass(frozen=True, slots=True)
class PlayResult:
    """One played episode.

    Args:
        episode: The episode.
        actions: The actions that were executed.
        outcome: Success, failure, or neither; `reason` says why it is not solved.
        scene: The scene at the end.
        frames: Both views, front above top, before the first step and after each, shape (256, 256, 3), uint8;
            empty unless asked for.
    """

    episode: Episode = field(repr=False)
    actions: tuple[Action, ...] = field(repr=False)
    outcome: Outcome
    scene: Scene = field(repr=False)
    frames: tuple[np.ndarray, ...] = field(default=(), repr=False, compare=False)

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.actions)


def play(
    episode: Episode | str | Path,
    policy: str | Policy = "openvima-small",
    *,
    video: str | Path | None = None,
    frames: bool = False,
    assets: str | Path | Assets = "procedural",
    compat: bool = False,
    device: str = DEFAULT_DEVICE,
    boxes: str = "",
    trust_code: bool = False,
) -> PlayResult:
    """Play one episode, composed or sampled.

    Args:
        episode: The episode, or a YAML or JSON file of one.
        policy: An object with `reset` and `act`, or a name as for `openvima evaluate --policy`, such as
            "oracle", where the episode has goals.
        video: MP4 file to write; None: no video.
        frames: Whether to keep images of all steps.
        assets: Asset pack.
        compat: Reproduce VIMA-Bench's quirks.
        device: Where a network computes: "cpu", in float64, or "cuda", in float32.
        boxes: Detector instead of the true boxes, as for `openvima demo --boxes`; only with a name.
        trust_code: Run the code that a run folder names.

    Returns:
        Actions, outcome and final scene.

    Raises:
        UnknownPolicyError, InputFileError, ServerError: There is no such policy.
        PolicyError: The policy has no `reset` and `act`, or gives no action.
        InputFileError, SceneError: The episode's file is not valid.
        OracleError: The oracle has no goals to pursue.
        ConfigError: The name of the video does not end in .mp4.

    Example:
        >>> from openvima.tasks import sample_episode
        >>> play(sample_episode("rotate", seed=0), "oracle").outcome.success
        True
    """
    if not isinstance(episode, Episode):
        episode = load_episode(episode, assets=assets)
    if policy == ORACLE:
        require_goals(episode.problem)
    video = None if video is None else as_path(video)
    if video is not None and video.suffix.lower() != ".mp4":
        raise ConfigError(f"video is {str(video)!r}; videos are MP4 files; give a name that ends in .mp4.")
    if isinstance(policy, str):
        name = policy
        rollout_policy = load_own_rollout_policy(policy, device=device, boxes=boxes, trust_code=trust_code)
    else:
        name, rollout_policy = type(policy).__name__, policy
    session = EpisodeSession(
        episode, rollout_policy, assets=assets, compat=compat, record=video is not None, explain=False
    )
    scenes, title = [session.scene], f"{episode.task} · {Path(name).name}"
    with nullcontext() if video is None else EpisodeRecorder(session.env, video, title=title) as recorder:
        outcome = session.run() if recorder is None else session.run(recorder.record_step)
        if outcome is None:
            error = session.propose().error
            assert error is not None  # as there is a policy
            raise error
        if recorder is not None:
            recorder.record_outcome(outcome.success if episode.problem.goals else None, outcome.steps)
    scenes += [step.scene for step in session.steps]
    rasteriser = Rasteriser(session.env.assets)
    return PlayResult(
        episode,
        tuple(step.action for step in session.steps),
        Outcome(outcome.success, session.env.outcome.failure, outcome.reason),
        session.scene,
        tuple(front_above_top(rasteriser.scene(scene)) for scene in scenes) if frames else (),
    )
