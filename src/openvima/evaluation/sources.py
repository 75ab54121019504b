"""Policies of an evaluation: names, sources and hashes of weights."""

import hashlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from openvima.errors import ConfigError, InputFileError, UnknownPolicyError, echo
from openvima.input_files import expand_home, open_regular
from openvima.policies.base import Policy
from openvima.policies.loading import (
    LearnerCode,
    held_out_data,
    learner_code,
    parameters_hash,
    policy_of_code,
    reads_environments,
    tasks_left_out,
)
from openvima.policies.naming import (
    BUNDLED,
    ORACLE,
    RANDOM,
    UNTRAINED,
    PolicyRef,
    find_checkpoint,
    hub_commit,
    unknown_policy,
)
from openvima.serving.chat import DEFAULT_VLM, VlmConfig, require_extra
from openvima.serving.client import describe
from openvima.serving.lerobot import SERVER_MODULE, lerobot_name
from openvima.serving.protocol import DEFAULT_MODALITIES, check_address
from openvima.user_code import load_function, source_hash, without_folder

NAMED_POLICIES = (ORACLE, RANDOM, UNTRAINED)
TRAINED_KINDS = ("run", "code", "remote", "vlm")  # see `PolicySource.kind`
_WEIGHTS = (".safetensors", ".ckpt", ".pt")


@dataclass(frozen=True, slots=True)
class PolicySource:
    """A policy and its name in the results.

    Args:
        name: Name in the results.
        source: "oracle", "random", "untrained", "untrained:PRESET", the name of a bundled checkpoint,
            what else `load_policy` takes, or the address of a policy server.
    """

    name: str
    source: str

    @property
    def ref(self) -> PolicyRef:
        """What the source names."""
        return PolicyRef.parse(self.source)

    @property
    def kind(self) -> str:
        """Its kind in the results: oracle, random, untrained, remote, lerobot, vlm, code or run.

        "code" is a function that makes a policy; "run" is all else.
        """
        kind = self.ref.kind
        return "run" if kind in ("bundled", "path", "hub", "unknown") else kind

    @property
    def learner(self) -> LearnerCode | None:
        """The code of a learner of the user's own, if it is the run folder of one."""
        return learner_code(self.source) if self.kind == "run" and self.source not in BUNDLED else None

    def check(self, *, trust_code: bool = False) -> None:
        """Check the name before any work is done for it: no weights are loaded, no server is asked.

        Args:
            trust_code: Whether to run the code that a run folder names.

        Raises:
            ConfigError: It looks like the address of a server and cannot be one, there is no such function,
                a run folder names code, which is not trusted, or it is a LeRobot policy that is not served.
            UnknownPolicyError: There is no such path or preset, and it is not like an id on the Hub; or it is
                a preset, without weights.
        """
        kind = self.kind
        if kind == "lerobot":
            raise ConfigError(
                f"{echo(self.source)} runs in LeRobot's own environment: name its Python with `openvima "
                f"evaluate --python`, or run PYTHON -m {SERVER_MODULE} PATH_OR_ID and give its address, ws://…."
            )
        if kind == "vlm":
            require_extra()
        elif kind == "remote":
            check_address(self.source)
        elif kind == "code":
            load_function(self.source, what="policy")
        elif kind == UNTRAINED:
            _ = self.ref.preset  # raises
        elif code := self.learner:
            code.check(trusted=trust_code)
        elif kind == "run" and not self.ref.has_weights:
            raise UnknownPolicyError(unknown_policy(self.source, NAMED_POLICIES))

    def record(self, vlm: VlmConfig = DEFAULT_VLM) -> dict[str, Any]:
        """What the policy is, if `check` raises nothing.

        Args:
            vlm: How a vision-language model is asked.

        Returns:
            Plain values, "kind" first: for a remote policy what it says; for a vision-language model its name
            and how it is asked; for a run "sha256" of its weights,
            "hub" with repository and commit if it is from there, and, as its settings declare,
            "excluded_tasks" of its training and "held_out_data", the demonstrations among its data that are
            held out for evaluation;
            for a function its name without folders, "sha256" of its source file, and `object_record` of its
            policy. Files that the source file imports are not hashed.

        Raises:
            ConfigError: A function cannot be called.
            InputFileError: The run folder, or the package, holds no weights.
            PolicyError: A folder here is named like a bundled checkpoint and holds a checkpoint, too.
            ServerError: No policy server answers at the address.
        """
        kind, about = self.kind, dict[str, Any]()
        if kind == "vlm":
            about = vlm.record(self.ref.model)
        elif kind == "remote":
            about = {"metadata": describe(self.source)}
        elif kind == "code":
            about = {**_code_record(self.source), **object_record(policy_of_code(self.source))}
        elif self.source in BUNDLED:
            about = {"bundled": self.source, "sha256": weights_hash(self.source)}
        elif kind == "run":
            code = self.learner
            declared = {
                "code": code and _code_record(code.source),
                "excluded_tasks": tasks_left_out(self.source),
                "held_out_data": held_out_data(self.source),
                "hub": hub_commit(self.source),
            }
            known = {name: value for name, value in declared.items() if value}
            about = {"sha256": weights_hash(self.source), **known}
        elif kind == UNTRAINED and self.source != UNTRAINED:
            about = {"preset": self.ref.preset}
        return {"kind": kind, **about}


def policy_sources(policies: Sequence[str]) -> tuple[PolicySource, ...]:
    """Read policies as given on the command line.

    Args:
        policies: Sources, or NAME=SOURCE; an existing path is a source, whatever it contains.

    Raises:
        ConfigError: Two policies have the same name, a name is not fit for file names, or an address without
            a name cannot be one.
    """
    sources = []
    for given in policies:
        given = expand_home(given)
        whole = PolicyRef.parse(given).kind == "remote" or os.path.exists(given)  # such as runs/lr=0.001
        name, equals, source = ("", "", given) if whole else given.partition("=")
        if not equals:
            name, source = _default_name(given), given
        sources.append(PolicySource(name, source))
    names = [source.name for source in sources]
    wrong = any(not s.source or re.fullmatch(r"\w[\w.+-]*", s.name) is None for s in sources)
    if wrong or len(set(names)) < len(names):
        raise ConfigError(
            "policies need distinct names of letters, digits, dots and hyphens, got "
            f"{echo(', '.join(names))}; name them as NAME=PATH."
        )
    return tuple(sources)


def weights_hash(source: str | Path) -> str:
    """SHA-256 over the weights that a folder, file, name or id on the Hub stands for, as hexadecimal text.

    Raises:
        InputFileError: There is no such folder or file, it holds no weights, or the Hub does not give it.
    """
    found = find_checkpoint(source)
    files = [found] if found.is_file() else sorted(found.iterdir())
    files = [file for file in files if file.suffix in _WEIGHTS and file.stem != "optimizer"]
    if not files:
        raise InputFileError(f"{source} holds no weights; give the folder of a training run.")
    digest = hashlib.sha256()
    for file in files:
        with open_regular(file) as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def object_record(policy: Policy) -> dict[str, Any]:
    """What is known of a policy object: "modalities" of its observations, and "weights_sha256" if it has any.

    "reads" is "environment" for a control, which is no policy.

    Raises:
        PolicyError: Its `weights_hash` is or returns no text.
    """
    weights = parameters_hash(policy)
    asked = getattr(policy, "modalities", DEFAULT_MODALITIES)
    modalities = [asked] if isinstance(asked, str) else list(asked)
    control = {"reads": "environment"} if reads_environments(policy) else {}
    return {"modalities": modalities, **control} | ({} if weights is None else {"weights_sha256": weights})


def _default_name(source: str) -> str:
    kind = PolicyRef.parse(source).kind
    if kind == "remote":
        check_address(source)
        name = urlsplit(source).netloc
    elif kind == "lerobot":
        name = lerobot_name(source)
    elif kind == "code":
        name = Path(source.rpartition(":")[0] or source).name.removesuffix(".py")
    else:
        name = Path(source).name
    return re.sub(r"[^\w.+-]+", "-", name).strip("-")


def _code_record(source: str) -> dict[str, str]:
    return {"source": without_folder(source), "sha256": source_hash(source, what="policy")}
