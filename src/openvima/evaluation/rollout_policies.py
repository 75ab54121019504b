"""Rollout policies: the oracle, which reads the environment, and policies, which read observations."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, Protocol

from openvima.detector.plugins import plugged_extractor
from openvima.env.tabletop import DEFAULT_MODALITIES, TabletopEnv
from openvima.errors import OracleError
from openvima.evaluation.ablations import AblatedInput, ablate
from openvima.evaluation.config import Batch
from openvima.evaluation.sources import ORACLE, RANDOM
from openvima.scene import Action
from openvima.serving.client import RemotePolicy
from openvima.serving.protocol import is_remote

Observation = Mapping[str, Any]  # as `TabletopEnv.step` returns it
Decision = Mapping[str, Any] | Action | OracleError | None


class RolloutPolicy(Protocol):
    """Decides actions for a batch of environments."""

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start a batch of episodes; every environment has been reset."""
        ...

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Give the next action of each environment.

        The answer is None where the episode is over, and an error where an oracle has no action.
        """
        ...

    def near_ties(self) -> Sequence[bool]:
        """Say of each environment whether rounding may have chosen its last action; empty if not known."""
        ...


class OracleRolloutPolicy:
    """The scripted oracle, which knows the scene."""

    def __init__(self) -> None:
        self._envs: Sequence[TabletopEnv] = ()

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Keep the environments, whose scenes the oracle reads."""
        self._envs = envs

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Ask each environment's oracle."""
        pairs = zip(self._envs, observations, strict=True)
        return [None if observation is None else _oracle(env) for env, observation in pairs]

    def near_ties(self) -> Sequence[bool]:
        """Return nothing: the oracle has no scores."""
        return ()


class PromptedRolloutPolicy:
    """A policy, which reads prompts and observations only.

    Args:
        policy: Follows the `Policy` protocol of `openvima.policies`.
        ablation: Input ablation; empty for none.
    """

    def __init__(self, policy: Any, ablation: str = "") -> None:  # Any: third parties need no base class
        self._policy = policy
        self._ablation = ablation
        self._inputs: list[AblatedInput] = []

    @property
    def modalities(self) -> tuple[str, ...]:
        """What the policy asks observations to hold, as `TabletopEnv` takes it."""
        return getattr(self._policy, "modalities", DEFAULT_MODALITIES)

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Reset the policy with the prompts."""
        self._inputs = [ablate(env, self._ablation) for env in envs]
        self._policy.reset([seen.prompt for seen in self._inputs])

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Let the policy act."""
        pairs = zip(self._inputs, observations, strict=True)
        return self._policy.act([None if image is None else seen.observation(image) for seen, image in pairs])

    def near_ties(self) -> Sequence[bool]:
        """Return those of the policy, if it reports any, as `NetworkPolicy` does."""
        return getattr(self._policy, "near_ties", ())


def load_rollout_policy(batch: Batch, fingerprint: str = "") -> RolloutPolicy:
    """Load the policy of a batch of episodes.

    Args:
        batch: The episodes.
        fingerprint: Text that stands for the policy's weights; a policy that was loaded before is used again
            only if it is the same.

    Raises:
        UnknownPolicyError: There is no such policy or run folder.
        CheckpointError: The checkpoint is damaged.
        ConfigError: There is no such detector.
        ServerError: No policy server answers at the address.
    """
    if batch.source == ORACLE:
        return OracleRolloutPolicy()
    policy = _load_policy(batch.source, fingerprint, batch.device, batch.precision, batch.boxes)
    return PromptedRolloutPolicy(policy, batch.ablation)


@contextmanager
def one_thread(batch: Batch) -> Iterator[None]:
    """Keep torch to one thread: sums in another order would change the last bits of what a network gives."""
    if batch.source in (ORACLE, RANDOM) or is_remote(batch.source):  # no network, or not here
        yield
        return
    from openvima.policies.base import require_torch

    require_torch(f"policy {batch.policy!r}")
    from openvima.policies.devices import torch_threads

    with torch_threads(1):
        yield


@lru_cache(maxsize=1)
def _load_policy(
    source: str, fingerprint: str, device: str, precision: str, boxes: str
) -> Any:  # Any: see `PromptedRolloutPolicy`
    from openvima.policies import load_policy

    if is_remote(source):
        _load_policy.cache_clear()  # ends the connection before: a server may let in one client only
        return RemotePolicy(source)
    options: dict[str, Any] = {"device": device}  # Any: of several kinds
    if precision:
        import torch

        options["dtype"] = getattr(torch, precision)
    if boxes:
        options["extractor"] = plugged_extractor(boxes)
    return load_policy(source, **options)


def _oracle(env: TabletopEnv) -> Action | OracleError:
    try:
        return env.oracle_decision().action
    except OracleError as error:
        return error
