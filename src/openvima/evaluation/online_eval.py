"""Online evaluation of checkpoints during training."""

from dataclasses import dataclass
from pathlib import Path

from openvima.env.config import DEFAULT_ENV_CONFIG, EnvConfig
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.policies.loading import load_policy

ONLINE_EVAL_LEVEL = "L1"
_DOMAIN = "user"  # evaluation episodes are kept for finished policies


@dataclass(frozen=True, slots=True)
class OnlineEval:
    """Evaluates checkpoints on the same episodes of some tasks.

    Args:
        tasks: Names of the tasks.
        episodes: Episodes of each task, at level L1; none of them occurs in training or evaluation.
        env_config: Settings of the environments.
        device: Where the policy computes.
    """

    tasks: tuple[str, ...]
    episodes: int
    env_config: EnvConfig = DEFAULT_ENV_CONFIG
    device: str = "cpu"

    def __call__(self, checkpoint: Path) -> dict[str, float]:
        """Return the success rate of each task, and their mean as "success"."""
        policy = load_policy(str(checkpoint), device=self.device, trust_code=True)  # the training runs it
        rates = {task: self._rate(task, policy) for task in self.tasks}
        return {"success": sum(rates.values()) / len(rates), **rates}

    def _rate(self, task: str, policy: object) -> float:
        seeds = range(self.episodes)
        envs = [self.env_config.make(task, ONLINE_EVAL_LEVEL, domain=_DOMAIN) for _ in seeds]
        outcomes = play(envs, seeds, PromptedRolloutPolicy(policy))
        return sum(outcome.success for outcome in outcomes) / len(outcomes)
