"""Multimodal-prompt robot manipulation: a fast, deterministic VIMA-Bench and the VIMA policy family."""

import importlib
from typing import TYPE_CHECKING

from openvima.env.registration import make, register_with_gymnasium

if TYPE_CHECKING:
    from openvima.env import TabletopEnv, make_vec
    from openvima.tasks import list_tasks

__version__ = "0.1.0"

__all__ = ["TabletopEnv", "__version__", "list_tasks", "make", "make_vec"]

_HOMES = {"TabletopEnv": "env", "make_vec": "env", "list_tasks": "tasks"}


def __getattr__(name: str) -> object:  # these import heavier packages
    if name in _HOMES:
        return getattr(importlib.import_module(f"openvima.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register_with_gymnasium()
