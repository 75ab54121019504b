"""Loading policies by name, from a folder or from the Hugging Face Hub."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from openvima.errors import ConfigError, PolicyError, UnknownPolicyError
from openvima.input_files import as_text
from openvima.policies.base import Policy, RandomPolicy, require_torch
from openvima.policies.own_code import learner_code, policy_of_code, policy_of_run
from openvima.policies.presets import UNTRAINED, is_untrained, untrained_preset
from openvima.policies.sources import is_own_code, is_policy_source, unknown_policy


def load_policy(
    name_or_run: str | Path,
    *,
    seed: int = 0,
    trust_code: bool = False,
    **options: Any,  # Any: of several kinds
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
        CheckpointError: The folder or file holds no readable checkpoint, or the download failed.
        ConfigError: There is no such function, or it raises; the run folder names code, which is not trusted;
            or an extractor is given to a policy of your own.
        PolicyError: A function returns something else than a policy; the policy needs the T5 tokenizer,
            which is neither stored nor given; or a local folder is named "untrained", or holds a
            checkpoint and has the name of a bundled one.
        MissingExtraError: The policy needs torch, or the Hub's client, which is not installed.
    """
    name_or_run = as_text(name_or_run)
    if name_or_run == "random":
        return RandomPolicy(seed)
    if is_untrained(name_or_run):
        name = untrained_preset(name_or_run)
        if Path(name_or_run).is_dir():
            raise PolicyError(
                f"{name_or_run!r} is a network with fresh weights, and a folder here; write ./{name_or_run} "
                "for the folder, or work elsewhere for the network."
            )
        require_torch(f"policy {name_or_run!r}")
        from openvima.policies.build import build_network
        from openvima.policies.inference import NetworkPolicy
        from openvima.policies.presets import preset

        return NetworkPolicy(build_network(preset(name), seed=seed), **options)
    if is_own_code(name_or_run):
        _check_extractor(name_or_run, options)
        return policy_of_code(name_or_run)
    if not is_policy_source(name_or_run):
        raise UnknownPolicyError(unknown_policy(name_or_run, ("random", UNTRAINED)))
    if code := learner_code(name_or_run):
        code.check(trusted=trust_code)
        _check_extractor(name_or_run, options)
        return policy_of_run(name_or_run, code, device=options.get("device", "cpu"))
    require_torch(f"the policy in {name_or_run}")
    from openvima.policies.inference import NetworkPolicy

    return NetworkPolicy.from_pretrained(name_or_run, **options)


def _check_extractor(source: str, options: Mapping[str, Any]) -> None:  # Any: see `load_policy`
    if options.get("extractor") is not None:
        raise ConfigError(f"{source} extracts objects itself; leave the detector out.")
