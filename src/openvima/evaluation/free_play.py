"""Playing a single episode with any policy."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from openvima.catalog import Assets
from openvima.env.config import DEFAULT_ENV_CONFIG
from openvima.env.episode_file import load_episode
from openvima.errors import ActionError, ConfigError, OracleError, PolicyError
from openvima.evaluation.config import DEFAULT_DEVICE, Batch
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy, RolloutPolicy, load_rollout_policy
from openvima.evaluation.session import EpisodeSession
from openvima.evaluation.sources import PolicySource
from openvima.input_files import as_path
from openvima.policies.base import Policy
from openvima.policies.naming import ORACLE
from openvima.render.rasteriser import Rasteriser, front_above_top
from openvima.scene import Action, Episode, Outcome, Scene
from openvima.scene.explanation import Explanation
from openvima.tasks.oracle import require_goals
from openvima.video.recorder import EpisodeRecorder


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
    title: str | None = None,
    explain: bool = False,
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
        title: Caption of the video; by default task and policy.
        explain: Draw what the policy considered beside the video.

    Returns:
        Actions, outcome and final scene.

    Raises:
        UnknownPolicyError, CheckpointError, ServerError: There is no such policy.
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
    rollout_policy = _load(policy, episode, device=device, boxes=boxes, trust_code=trust_code)
    if explain:
        rollout_policy.explainer()  # raises now
    session = EpisodeSession(
        episode, rollout_policy, assets=assets, compat=compat, record=video is not None, explain=explain
    )
    if video is None:
        outcome = _run(session)
    else:
        name = policy if isinstance(policy, str) else type(policy).__name__
        caption = f"{episode.task} · {Path(name).name}" if title is None else title
        with EpisodeRecorder(
            session.env,
            video,
            title=caption,
            explain=partial(_explanation, session) if explain else None,
        ) as recorder:
            outcome = _run(session, recorder)
            recorder.record_outcome(outcome.success if episode.problem.goals else None, outcome.steps)
    scenes = [*(step.before for step in session.steps), session.scene] if frames else []
    rasteriser = Rasteriser(session.env.assets)
    return PlayResult(
        episode,
        tuple(step.action for step in session.steps),
        Outcome(outcome.success, session.env.outcome.failure, outcome.reason),
        session.scene,
        tuple(front_above_top(rasteriser.scene(scene)) for scene in scenes),
    )


def _run(session: EpisodeSession, recorder: EpisodeRecorder | None = None) -> EpisodeOutcome:
    """Step to the end, and raise what the policy raises."""
    while session.outcome is None:
        error = session.propose().error
        if error is not None and not isinstance(error, ActionError | OracleError):  # these end the episode
            raise error
        if session.step() is not None and recorder is not None:
            recorder.record_step(session.env)
    return session.outcome


def _explanation(session: EpisodeSession) -> Explanation:
    explanation = session.steps[-1].proposal.explanation
    if explanation is None:
        raise PolicyError("explain() of the policy returned None for an episode that goes on.")
    return explanation


def _load(
    policy: str | Policy, episode: Episode, *, device: str, boxes: str, trust_code: bool
) -> RolloutPolicy:
    """Load a policy by name, or take an object."""
    if not isinstance(policy, str):
        return PromptedRolloutPolicy(policy)
    PolicySource(policy, policy, trust_code).check()
    batch = Batch(
        policy,
        policy,
        episode.task,
        episode.level,
        first_seed=episode.seed,
        episodes=1,
        env_config=DEFAULT_ENV_CONFIG,
        device=device,
        boxes=boxes,
        trust_code=trust_code,
    )
    return load_rollout_policy(batch)
