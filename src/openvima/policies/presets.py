"""Presets: named functions that return validated configs."""

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING

from openvima.errors import UnknownPolicyError, unknown_name

if TYPE_CHECKING:
    from openvima.policies.config import PolicyConfig

PUBLISHED = ("vima", "gato", "flamingo", "gpt", "midas")  # architectures of the papers, in all sizes
# Repeats the keys of `sizes.SIZES`, so that listing presets does not import torch; a test compares them.
SIZE_NAMES = ("nano", "2m", "4m", "9m", "20m", "43m", "92m", "200m")


def _config(module: str, function: str) -> "PolicyConfig":
    return getattr(import_module(f"openvima.policies.{module}"), function)()


def _sized(architecture: str, size_name: str) -> "PolicyConfig":
    from openvima.policies import architectures
    from openvima.policies.sizes import size

    return getattr(architectures, architecture)(size(size_name))


PRESETS: dict[str, Callable[[], "PolicyConfig"]] = {
    "nano": partial(_config, "pointer.config", "nano"),
    "nano-bins": partial(_config, "architectures", "nano_bins"),
    "small": partial(_config, "pointer.config", "small"),
    **{f"{name}-{size}": partial(_sized, name, size) for name in PUBLISHED for size in SIZE_NAMES},
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
