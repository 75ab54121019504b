"""Playing a single episode with any policy."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from openvima.catalog import Assets
from openvima.env.config import DEFAULT_ENV_CONFIG
from openvima.env.tabletop import TabletopEnv
from openvima.evaluation.actions import ActionRecorder, action_arrays
from openvima.evaluation.config import DEFAULT_DEVICE, Batch
from openvima.evaluation.recording import record_episode
from openvima.evaluation.rollout import play as roll_out
from openvima.evaluation.rollout_policies import (
    Decision,
    Observation,
    PromptedRolloutPolicy,
    RolloutPolicy,
    load_rollout_policy,
)
from openvima.evaluation.sources import PolicySource
from openvima.policies.base import Policy
from openvima.scene import Action, Episode, Outcome, Scene

_HOST_TASK = "visual_manipulation"  # an environment of any task plays all episodes


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
    episode: Episode,
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
        episode: The episode.
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

    Example:
        >>> from openvima.tasks import sample_episode
        >>> play(sample_episode("rotate", seed=0), "oracle").outcome.success
        True
    """
    rollout_policy = _load(policy, episode, device=device, boxes=boxes, trust_code=trust_code)
    render_mode = "rgb_array" if frames else None
    env = TabletopEnv(
        _HOST_TASK, assets=assets, compat=compat, realtime=video is not None, render_mode=render_mode
    )
    recorder = _FrameRecorder(rollout_policy, frames)
    if video is None:
        (ended,) = roll_out([env], [episode], recorder)
    else:
        name = policy if isinstance(policy, str) else type(policy).__name__
        caption = f"{episode.task} · {Path(name).name}" if title is None else title
        ended = record_episode(env, recorder, episode, Path(video), title=caption, explain=explain)
    return PlayResult(
        episode,
        tuple(Action.from_arrays(action_arrays(step)) for step in recorder.steps[0]),
        Outcome(ended.success, env.outcome.failure, ended.reason),
        env.scene,
        (*recorder.frames, _rendered(env)) if frames else (),
    )


class _FrameRecorder(ActionRecorder):
    """Keeps an image before each action too."""

    def __init__(self, policy: RolloutPolicy, with_frames: bool) -> None:
        super().__init__(policy)
        self._with_frames = with_frames
        self._envs: Sequence[TabletopEnv] = ()
        self.frames: list[np.ndarray] = []

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start the episode."""
        self._envs = envs
        super().begin(envs)

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Pass on the decision."""
        if self._with_frames:
            self.frames.append(_rendered(self._envs[0]))
        return super().decide(observations)


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


def _rendered(env: TabletopEnv) -> np.ndarray:
    image = env.render()
    assert image is not None  # the environment was made to render
    return image
