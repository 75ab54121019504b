"""Loading policies: by name, from a folder or the Hugging Face Hub, and from code of users."""

import hashlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

from openvima.errors import ConfigError, OpenVimaError, PolicyError, UnknownPolicyError, echo
from openvima.input_files import read_yaml
from openvima.policies.base import Policy, RandomPolicy, require_torch, usable_device
from openvima.policies.naming import (
    CHECKPOINTS_FOLDER,
    CONFIG_FILE,
    RANDOM,
    UNTRAINED,
    PolicyRef,
    checkpoint_folder,
    unknown_policy,
)
from openvima.policies.presets import preset
from openvima.user_code import call_function, is_code


@dataclass(frozen=True, slots=True)
class LearnerCode:
    """The code of a run folder's learner.

    Args:
        source: MODULE:FUNCTION or FILE.py:FUNCTION.
        file: The config that names it.
    """

    source: str
    file: Path

    def check(self, *, trusted: bool) -> None:
        """Refuse code that a file names, unless it is trusted.

        Raises:
            ConfigError: It is not.
        """
        if not trusted:
            raise ConfigError(
                f"{self.file} names code to run: {self.source}. Nothing was executed. If you trust the run "
                "folder, add --trust-code (trust_code=True in Python)."
            )


def learner_code(folder: str | Path) -> LearnerCode | None:
    """Return the code that a run folder, or one of its checkpoints, names as its learner; None without any.

    Nothing is executed.
    """
    file, preset = run_setting(folder, "training", "preset")
    return LearnerCode(preset, file) if isinstance(preset, str) and is_code(preset) else None


def tasks_left_out(folder: str | Path) -> list[str]:
    """Return the tasks that the training of a run folder, or of one of its checkpoints, excluded."""
    _, tasks = run_setting(folder, "training", "loader", "exclude_tasks")
    return tasks.split(",") if isinstance(tasks, str) and tasks else []


def held_out_data(folder: str | Path) -> list[str]:
    """Return the tasks and levels held out for evaluation on which a run folder was trained all the same."""
    _, found = run_setting(folder, "demonstrations", "held_out")
    return [echo(name) for name in found if isinstance(name, str)] if isinstance(found, list) else []


def run_setting(folder: str | Path, *names: str) -> tuple[Path, Any]:
    """Return what the run that a folder belongs to records under names, and before it the file that does.

    The names lead from section to section, as in "training", "loader"; None if nothing is recorded there.
    """
    path = Path(folder)
    run = path.absolute().parent
    for place in (path, run.parent) if run.name == CHECKPOINTS_FOLDER else (path,):
        file = place / CONFIG_FILE
        try:
            return file, reduce(getitem, names, read_yaml(file))
        except (OSError, OpenVimaError, KeyError, TypeError):
            continue
    return path, None


def reads_environments(policy: Any) -> bool:
    """Whether an object is a control, which reads environments: it has the methods of a `RolloutPolicy`."""
    return callable(getattr(policy, "begin", None)) and callable(getattr(policy, "decide", None))


def policy_of_code(source: str) -> Any:
    """Call a function that makes a policy, or a control.

    Args:
        source: MODULE:FUNCTION or FILE.py:FUNCTION; the function needs no arguments.

    Raises:
        ConfigError: There is no such function, or it raises.
        PolicyError: It returns something else.
    """
    made = call_function(source, what="policy")
    return made if reads_environments(made) else checked_policy(made, f"{source} returned")


def policy_of_run(folder: str | Path, code: LearnerCode, *, device: str = "cpu") -> Policy:
    """Load the learner of a run folder with its best weights, and return its policy.

    Args:
        folder: The run folder or one of its checkpoints.
        code: The function that makes the learner; it is executed.
        device: Where the learner computes.

    Raises:
        ConfigError: There is no such function, it raises, or the learner has no policy.
        InputFileError: The weights are damaged or do not fit.
        PolicyError: `Learner.policy` returns something else than a policy.
    """
    require_torch(f"the policy in {folder}")
    learner = call_function(code.source, what=f"preset in {code.file}")
    learner.read(checkpoint_folder(Path(folder)))
    learner.to(usable_device(device)).eval()
    return checked_policy(learner.policy(), f"policy() of {type(learner).__name__} returned")


def checked_policy(policy: Any, what: str) -> Policy:
    """Return an object if it has the methods of a policy.

    Args:
        policy: The object.
        what: Begins the error, as in "my_policy.py:make returned".

    Raises:
        PolicyError: A method is missing.
    """
    if isinstance(policy, type):
        name = policy.__name__
        raise PolicyError(f"{what} the class {name}, not an object of it; return {name}().")
    missing = [name for name in ("reset", "act") if not callable(getattr(policy, name, None))]
    if missing:
        raise PolicyError(
            f"{what} a {type(policy).__name__} without {' and '.join(missing)}; a policy has the methods "
            "reset(prompts) and act(observations), see docs/your_own_policy.md."
        )
    return policy


def parameters_hash(policy: Any) -> str | None:
    """SHA-256 of the weights of a policy object, as hexadecimal text; None if it offers none.

    A policy offers weights by `weights_hash`, a text or a method that returns one, or by being or having as
    attributes torch modules, whose parameters and buffers are hashed with their names.

    Raises:
        PolicyError: `weights_hash` is or returns no text.
    """
    own = getattr(policy, "weights_hash", None)
    if own is not None:
        own = own() if callable(own) else own
        if not isinstance(own, str):
            raise PolicyError(
                f"weights_hash of {type(policy).__name__} is a {type(own).__name__}; give a text."
            )
        return own
    torch = sys.modules.get("torch")
    if torch is None:  # then no policy can have a module of it
        return None
    held: Mapping[str, Any] = {"": policy, **getattr(policy, "__dict__", {})}
    modules = {name: value for name, value in sorted(held.items()) if isinstance(value, torch.nn.Module)}
    if "" in modules:
        modules = {"": policy}
    digest = hashlib.sha256()
    for name, module in modules.items():
        for key, tensor in module.state_dict().items():
            if isinstance(tensor, torch.Tensor):
                digest.update(f"{name}.{key} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
                flat = tensor.detach().cpu().contiguous().reshape(-1)
                digest.update(flat.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest() if modules else None


def load_policy(
    name_or_run: str | Path,
    *,
    seed: int = 0,
    trust_code: bool = False,
    **options: Any,
) -> Policy:
    """Load a policy by name, from a folder or file, or from the Hugging Face Hub.

    Args:
        name_or_run: "random"; "untrained" or "untrained:PRESET", for fresh weights of nano or of another
            preset; "openvima-small", the bundled checkpoint; a run folder of `openvima train`, of which the
            best checkpoint is loaded; a checkpoint folder; a published `.ckpt` file; a name on the Hub such
            as "owner/policy@v1"; or "MODULE:FUNCTION" or "FILE.py:FUNCTION", a function without arguments
            that returns a policy. A `Path` is always a local one.
        seed: Seed of the random policy and of fresh weights.
        trust_code: Whether to run the code that the run folder of a learner of your own names.
        **options: Options of `NetworkPolicy`, such as `tokenizer`, `device` or `dtype`. The random policy
            and policies of functions ignore them; a learner of your own takes `device` alone.

    Returns:
        The policy, ready for `reset`.

    Raises:
        UnknownPolicyError: It is neither a known name, nor a path, nor a possible Hub id; or that of a
            preset, which has no weights.
        InputFileError: The folder or file holds no readable checkpoint, or the download failed.
        ConfigError: There is no such function, or it raises; the run folder names code, which is not trusted;
            or an extractor is given to a policy of your own.
        PolicyError: A function returns something else than a policy; the policy needs the T5 tokenizer,
            which is neither stored nor given; or a local folder is named "untrained", or holds a
            checkpoint and has the name of a bundled one.
        MissingExtraError: The policy needs torch, or the Hub's client, which is not installed.
    """
    ref = PolicyRef.parse(name_or_run)
    source = ref.text
    if ref.kind == RANDOM:
        return RandomPolicy(seed)
    if ref.kind == UNTRAINED:
        name = ref.preset
        if Path(source).is_dir():
            raise PolicyError(
                f"{source!r} is a network with fresh weights, and a folder here; write ./{source} "
                "for the folder, or work elsewhere for the network."
            )
        require_torch(f"policy {source!r}")
        from openvima.policies.build import build_network
        from openvima.policies.inference import NetworkPolicy

        return NetworkPolicy(build_network(preset(name), seed=seed), **options)
    if ref.kind == "code":
        _check_extractor(source, options)
        return policy_of_code(source)
    if not ref.has_weights:
        raise UnknownPolicyError(unknown_policy(source, (RANDOM, UNTRAINED)))
    if code := learner_code(source):
        code.check(trusted=trust_code)
        _check_extractor(source, options)
        return policy_of_run(source, code, device=options.get("device", "cpu"))
    require_torch(f"the policy in {source}")
    from openvima.policies.checkpoint import load_network
    from openvima.policies.inference import NetworkPolicy
    from openvima.policies.t5 import tokenizer_for

    network, stored = load_network(source)
    tokenizer = options.pop("tokenizer", None) or tokenizer_for(network.config.prompt, stored)
    return NetworkPolicy(network, tokenizer=tokenizer, **options)


def _check_extractor(source: str, options: Mapping[str, Any]) -> None:
    if options.get("extractor") is not None:
        raise ConfigError(f"{source} extracts objects itself; leave the detector out.")
