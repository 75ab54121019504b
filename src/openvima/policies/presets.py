"""Presets: named functions that return validated configs, and learners of users by name.

A learner of your own is registered by a function without arguments that makes it:

    @register_policy("mine")
    def make() -> Learner: ...

Its file is found by the environment variable OPENVIMA_POLICY_FILES, or by an entry point of the group
openvima.policies; then `openvima train --preset mine` trains it.
"""

import os
import re
from collections.abc import Callable, Mapping
from functools import cache, partial
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from openvima.errors import ConfigError, UnknownPolicyError, echo, unknown_name
from openvima.user_code import load_entry_point, load_file

if TYPE_CHECKING:
    from openvima.policies.build import PolicyConfig

PUBLISHED = ("vima", "gato", "flamingo", "gpt", "midas")  # architectures of the papers, in all sizes
POLICY_FILES_VARIABLE = "OPENVIMA_POLICY_FILES"
ENTRY_POINTS = "openvima.policies"
_NAME = re.compile(r"\w[\w-]{0,99}", re.ASCII)
_Make = TypeVar("_Make", bound=Callable[[], Any])
_own: dict[str, str] = {}  # registered name -> MODULE:FUNCTION or FILE.py:FUNCTION
# Repeats the keys of `sizes.SIZES`, so that listing presets does not import torch; a test compares them.
SIZE_NAMES = ("nano", "2m", "4m", "9m", "20m", "43m", "92m", "200m")


def _config(module: str, function: str, *size_names: str) -> "PolicyConfig":
    from openvima.policies.sizes import SIZES

    build = getattr(import_module(f"openvima.policies.{module}"), function)
    return build(*(SIZES[name] for name in size_names))


PRESETS: dict[str, Callable[[], "PolicyConfig"]] = {
    "nano": partial(_config, "pointer.config", "nano"),
    "nano-bins": partial(_config, "architectures", "nano_bins"),
    "small": partial(_config, "pointer.config", "small"),
    **{
        f"{name}-{size}": partial(_config, "architectures", name, size)
        for name in PUBLISHED
        for size in SIZE_NAMES
    },
}


def preset(name: str) -> "PolicyConfig":
    """Return the config of a named network, such as "nano" or "vima-200m".

    Raises:
        UnknownPolicyError: There is no preset of that name.
    """
    check_preset(name)
    return PRESETS[name]()


def check_preset(name: str) -> None:
    """Raises `UnknownPolicyError` if there is no preset of that name."""
    if name not in PRESETS:
        hint = f"Allowed: nano, nano-bins, small, and {'|'.join(PUBLISHED)}-{'|'.join(SIZE_NAMES)}."
        raise UnknownPolicyError(unknown_name("preset", name, PRESETS, hint))


def register_policy(name: str) -> Callable[[_Make], _Make]:
    """Name a function that makes a learner, as `--preset FILE.py:FUNCTION` takes it.

    Args:
        name: Letters, digits, underscores and hyphens; that of no preset. The same name replaces a function.

    Raises:
        ConfigError: The name is not allowed.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name in PRESETS:
        raise ConfigError(
            f"a policy is named {echo(repr(name))}; give up to 100 letters, digits, underscores and hyphens, "
            "and not the name of a preset."
        )

    def register(make: _Make) -> _Make:
        _own[name] = f"{make.__module__}:{make.__qualname__}"
        return make

    return register


@cache
def own_policies() -> Mapping[str, str]:
    """Return the registered functions by name, as MODULE:FUNCTION or FILE.py:FUNCTION.

    Raises:
        ConfigError: A file or an entry point raises.
    """
    for entry_point in entry_points(group=ENTRY_POINTS):
        load_entry_point(entry_point)
    for path in filter(None, os.environ.get(POLICY_FILES_VARIABLE, "").split(os.pathsep)):
        module = load_file(Path(path), what=POLICY_FILES_VARIABLE).__name__
        for name, source in _own.items():
            if source.startswith(f"{module}:"):  # no other process could import it
                _own[name] = f"{Path(path).absolute()}{source.removeprefix(module)}"
    return _own
