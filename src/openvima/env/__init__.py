"""The Gymnasium environment."""

import importlib
from typing import TYPE_CHECKING

from openvima.env.registration import make, register_environments

if TYPE_CHECKING:
    from openvima.env.tabletop import Frame, TabletopEnv

__all__ = ["Frame", "TabletopEnv", "make", "register_environments"]


def __getattr__(name: str) -> object:  # importing the environment takes MuJoCo and Numba with it
    if name in ("Frame", "TabletopEnv"):
        return getattr(importlib.import_module("openvima.env.tabletop"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
