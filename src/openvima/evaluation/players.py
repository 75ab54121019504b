"""Who decides in an episode: the oracle, which asks the environment, or a policy, which sees observations."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, Protocol

from openvima.env.tabletop import TabletopEnv
from openvima.errors import OracleError
from openvima.evaluation.protocol import ORACLE, Batch
from openvima.scene import Action

Observation = Mapping[str, Any]  # as `TabletopEnv.step` returns it
Decision = Mapping[str, Any] | Action | OracleError | None


class Player(Protocol):
    """Decides for several environments at once."""

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start a batch of episodes; every environment has been reset."""
        ...

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Give the next action of each environment.

        The answer is None where the episode is over, and an error where an oracle has no action.
        """
        ...


class OraclePlayer:
    """The scripted oracle, which knows the scene."""

    def __init__(self) -> None:
        self._envs: Sequence[TabletopEnv] = ()

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Take the environments whose scenes to look at."""
        self._envs = envs

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Ask each environment's oracle."""
        pairs = zip(self._envs, observations, strict=True)
        return [None if observation is None else _oracle(env) for env, observation in pairs]


class PolicyPlayer:
    """A policy, which sees prompts and observations only.

    Args:
        policy: Follows the `Policy` protocol of `openvima.policies`.
    """

    def __init__(self, policy: Any) -> None:  # Any: policies of third parties need no base class
        self._policy = policy

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Tell the policy the prompts."""
        self._policy.reset([env.prompt for env in envs])

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Let the policy act."""
        return self._policy.act(observations)


def load_player(batch: Batch, fingerprint: str = "") -> Player:
    """Make the player of a batch of episodes.

    Args:
        batch: What will be played.
        fingerprint: Text that stands for the policy's weights; a policy that was loaded before is used again
            only if it is the same.

    Raises:
        UnknownPolicyError: There is no such policy or run folder.
        CheckpointError: The checkpoint is damaged.
    """
    if batch.source == ORACLE:
        return OraclePlayer()
    return PolicyPlayer(_load_policy(batch.source, fingerprint, batch.device))


@contextmanager
def one_thread(batch: Batch) -> Iterator[None]:
    """Keep torch to one thread: sums in another order would change the last bits of what a network gives."""
    if batch.source in ("oracle", "random"):  # no network
        yield
        return
    from openvima.policies.base import require_torch

    require_torch(f"policy {batch.policy!r}")
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@lru_cache(maxsize=1)
def _load_policy(source: str, fingerprint: str, device: str) -> Any:  # Any: see `PolicyPlayer`
    from openvima.policies import load_policy

    return load_policy(source, device=device)


def _oracle(env: TabletopEnv) -> Action | OracleError:
    try:
        return env.oracle_decision().action
    except OracleError as error:
        return error
