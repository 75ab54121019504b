"""Rollout policies: the oracle, which reads the environment, and policies, which read observations."""

import importlib.util
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from typing import Any, Protocol

import numpy as np

from openvima.detector.plugins import chat_extractor, plugged_extractor
from openvima.env.tabletop import DEFAULT_MODALITIES, TabletopEnv
from openvima.errors import (
    AnswerError,
    OpenVimaError,
    OracleError,
    PolicyError,
    PolicyRaisedError,
    UnknownWordWarning,
    echo,
)
from openvima.evaluation.ablations import AblatedInput, ablate
from openvima.evaluation.chat import Said, said_in, shot_turns
from openvima.evaluation.config import Batch
from openvima.evaluation.sources import PolicySource
from openvima.policies.base import require_torch, torch_threads
from openvima.policies.loading import checked_policy, reads_environments
from openvima.policies.naming import ORACLE, RANDOM, PolicyRef
from openvima.scene import Action
from openvima.scene.action import END_EFFECTOR, PRIMITIVES, ToolCommand
from openvima.scene.explanation import Explanation
from openvima.serving.chat import DEFAULT_VLM, ChatClient, VlmConfig, VlmPolicy
from openvima.serving.client import RemotePolicy
from openvima.user_code import described

_MAX_SEEDS = 16  # that an error lists
Observation = Mapping[str, Any]  # as `TabletopEnv.step` returns it
Decision = Mapping[str, Any] | Action | np.ndarray | ToolCommand | OracleError | AnswerError | None


class RolloutPolicy(Protocol):
    """Decides actions for a batch of environments.

    It may have `modalities`, `near_ties` and `explain` as a policy has them.
    """

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start a batch of episodes; every environment has been reset."""
        ...

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Give the next action of each environment.

        The answer is None where the episode is over, and an error where an oracle has no action, or where the
        words of a model hold none.
        """
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


def explainer_of(policy: RolloutPolicy) -> Callable[[], Explanation] | None:
    """Return what gives the explanation of a policy's last action in its only episode, if it explains any.

    It raises a `PolicyError` where the policy returns something else.
    """
    explain = getattr(policy, "explain", None)
    return None if explain is None else partial(_explanation, explain)


def _explanation(explain: Callable[[], Any]) -> Explanation:
    found = explain()
    if not (isinstance(found, list | tuple) and len(found) == 1 and isinstance(found[0], Explanation)):
        raise PolicyError(
            f"explain() returned {echo(repr(found))}; give a list of an Explanation for each episode that "
            "goes on, see docs/explain.md."
        )
    return found[0]


def _read(action: object) -> None:
    """Let values raise that do so when they are read, such as tensors with gradients.

    What NumPy cannot convert raises `TypeError` or `ValueError`, and is an invalid action later on.
    """
    for value in action.values() if isinstance(action, Mapping) else (action,):
        with suppress(TypeError, ValueError):
            np.asarray(value)


class PromptedRolloutPolicy:
    """A policy, which reads prompts and observations only; its `modalities` and `explain` are the policy's.

    Args:
        policy: Follows the `Policy` protocol of `openvima.policies`.
        ablation: Input ablation; empty for none.
        name: Name of the policy, for errors.
    """

    def __init__(self, policy: Any, ablation: str = "", *, name: str = "policy") -> None:
        self._policy = checked_policy(policy, f"{name} is")
        self.modalities: tuple[str, ...] = getattr(policy, "modalities", DEFAULT_MODALITIES)
        self.explain: Callable[[], Any] | None = getattr(policy, "explain", None)
        self._name = name
        self._envs: Sequence[TabletopEnv] = ()
        self._ablation = ablation
        self._inputs: list[AblatedInput] = []

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Reset the policy with the prompts.

        Raises:
            PolicyError: The policy raised another exception than those of this package, or is of another
                control than the environments.
        """
        own = getattr(self._policy, "control", PRIMITIVES)
        if own != (control := envs[0].control):
            raise PolicyError(
                f"{self._name} is a policy of control {own!r}, but the environments have control "
                f"{control!r}; evaluate with control {own!r}."
            )
        self._envs = envs
        self._inputs = [ablate(env, self._ablation) for env in envs]
        with self._named_errors(envs), warnings.catch_warnings():
            if self._ablation:  # gibberish is unknown on purpose
                warnings.simplefilter("ignore", UnknownWordWarning)
            self._policy.reset([seen.prompt for seen in self._inputs])

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Let the policy act.

        Raises:
            PolicyError: As for `begin`, or the policy gave something else than one action for each episode.
        """
        running = [env for env, seen in zip(self._envs, observations, strict=True) if seen is not None]
        pairs = zip(self._inputs, observations, strict=True)
        with self._named_errors(running):
            actions = self._policy.act(
                [None if image is None else seen.observation(image) for seen, image in pairs]
            )
        is_list = isinstance(actions, Sequence)
        if not is_list or len(actions) != len(observations):
            given = f"{len(actions)} actions" if is_list else f"a {type(actions).__name__}"
            raise PolicyError(
                f"{self._name} gave {given} for {len(observations)} observations; act must return a list "
                "with an action for each."
            )
        for env, seen, action in zip(self._envs, observations, actions, strict=True):
            if action is None and seen is not None:
                raise PolicyError(
                    f"{self._name} gave no action for {_episodes([env])}, whose episode is not over."
                )
            with self._named_errors([env]):
                _read(action)
        return actions

    @contextmanager
    def _named_errors(self, envs: Sequence[TabletopEnv]) -> Iterator[None]:
        """Name policy, task and seeds where the policy raises."""
        try:
            yield
        except PolicyRaisedError as error:  # on a server
            raise PolicyRaisedError(f"{self._name}: {error}, in {_episodes(envs)}.") from None
        except OpenVimaError:
            raise
        except Exception as error:
            raise PolicyRaisedError(
                f"{self._name} raised {described(error)}, in {_episodes(envs)}."
            ) from error

    @property
    def near_ties(self) -> Sequence[bool]:
        """Those of the policy, if it reports any, as `NetworkPolicy` does."""
        return getattr(self._policy, "near_ties", ())


class VlmRolloutPolicy(PromptedRolloutPolicy):
    """A vision-language model; `said` holds its answers in each episode of the batch, by step."""

    _policy: VlmPolicy

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Put demonstrations of the task before the episodes, if any are asked for."""
        env, client, form = envs[0], self._policy.client, self._policy.format
        key = (env.task, env.prompts, str(env.task_options))
        if key not in client.shots:
            count = client.config.options.shots
            client.shots[key] = shot_turns(env, count, form, self._policy.extractor)
        self._policy.shots = client.shots[key]
        self.said: list[Said] = [[] for _ in envs]
        super().begin(envs)

    def decide(self, observations: Sequence[Observation | None]) -> Sequence[Decision]:
        """Ask the model, and keep what it says."""
        decisions = super().decide(observations)
        for env, steps, answer, decision in zip(
            self._envs, self.said, self._policy.answers, decisions, strict=True
        ):
            if answer is not None:
                steps.append(said_in(env, answer, decision))
        return decisions


def load_rollout_policy(batch: Batch) -> RolloutPolicy:
    """Load the policy of a batch of episodes, or the one of the batch before if it has the same fingerprint.

    Raises:
        UnknownPolicyError: There is no such policy or run folder.
        InputFileError: The checkpoint is damaged.
        ConfigError: There is no such detector.
        ServerError: No policy server answers at the address.
    """
    policy = _load_policy(
        batch.source,
        batch.fingerprint,
        device=batch.device,
        precision=batch.precision,
        boxes=batch.boxes,
        trust_code=batch.trust_code,
        vlm=batch.vlm,
    )
    return as_rollout_policy(policy, batch.ablation, batch.policy)


def as_rollout_policy(policy: Any, ablation: str = "", name: str = "policy") -> RolloutPolicy:
    """Return what plays episodes by a policy; a control does so itself.

    Args:
        policy: A policy, or a rollout policy.
        ablation: Input ablation; empty for none.
        name: Name of the policy, for errors.

    Raises:
        PolicyError: It is neither, or an ablation cannot change what it reads.
    """
    if reads_environments(policy):
        if ablation:
            raise PolicyError(f"{name} reads environments, which {ablation!r} does not change; leave it out.")
        return policy
    if isinstance(policy, VlmPolicy):
        return VlmRolloutPolicy(policy.new_session(), ablation, name=name)
    return PromptedRolloutPolicy(policy, ablation, name=name)


@contextmanager
def one_thread(batch: Batch) -> Iterator[None]:
    """Keep torch to one thread: sums in another order would change the last bits of what a network gives."""
    kind = PolicyRef.parse(batch.source).kind
    without_torch = kind == "code" and importlib.util.find_spec("torch") is None
    if kind in (ORACLE, RANDOM, "remote", "vlm") or without_torch:  # no network here
        yield
        return
    require_torch(f"policy {batch.policy!r}")
    with torch_threads(1):
        yield


def load_own_rollout_policy(
    source: str,
    *,
    ablation: str = "",
    name: str = "",
    trust_code: bool = False,
    **options: Any,
) -> RolloutPolicy:
    """Load a policy that nobody else has a reference to, with episodes of its own.

    Args:
        source: As for `openvima evaluate --policy`.
        ablation: Input ablation; empty for none.
        name: Name of the policy, for errors; by default the source.
        trust_code: Run the code that a run folder names.
        **options: `boxes`, `device`, `precision` and `vlm`, as in `Batch`.

    Raises:
        UnknownPolicyError, InputFileError, ConfigError, ServerError: As for `load_rollout_policy`.
    """
    PolicySource(source, source).check(trust_code=trust_code)
    policy = build_policy(source, trust_code=trust_code, **options)
    return as_rollout_policy(policy, ablation, name or source)


@lru_cache(maxsize=1)
def _load_policy(source: str, fingerprint: str, **options: Any) -> Any:
    if PolicyRef.parse(source).kind == "remote":
        _load_policy.cache_clear()  # ends the connection before: a server may let in one client only
    return build_policy(source, **options)


def build_policy(
    source: str, *, boxes: str = "", precision: str = "", vlm: VlmConfig = DEFAULT_VLM, **options: Any
) -> Any:
    """Load a policy anew, with the options of a `Batch`; the errors are those of `load_rollout_policy`."""
    from openvima.policies import load_policy

    ref = PolicyRef.parse(source)
    if ref.kind == ORACLE:
        return OracleRolloutPolicy()
    if ref.kind == "remote":
        return RemotePolicy(source)
    if ref.kind == "vlm":
        return VlmPolicy(ChatClient(ref.model, vlm), chat_extractor(vlm.options.boxes))
    if precision:
        import torch

        options["dtype"] = getattr(torch, precision)
    if boxes:
        options["extractor"] = plugged_extractor(boxes)
    return load_policy(source, **options)


def _episodes(envs: Sequence[TabletopEnv]) -> str:
    """Name the episodes of a batch, which have one task and level."""
    seeds = [str(env.episode.seed) for env in envs]
    shown = ", ".join(seeds[:_MAX_SEEDS]) + ", …" * (len(seeds) > _MAX_SEEDS)
    return f"{envs[0].task}, {envs[0].level}, seed{'s' * (len(seeds) > 1)} {shown}"


def _oracle(env: TabletopEnv) -> Action | ToolCommand | OracleError:
    try:
        if env.control == END_EFFECTOR:
            return env.oracle_command()
        return env.oracle_decision().action
    except OracleError as error:
        return error
