"""The Gymnasium environment, alone or several at once."""

import importlib
from typing import TYPE_CHECKING

from openvima.env.config import EnvConfig
from openvima.env.registration import make, register_environments

if TYPE_CHECKING:
    from openvima.env.action_validation import stack_actions
    from openvima.env.tabletop import TabletopEnv, VideoFrame
    from openvima.env.vector import make_vec

__all__ = [
    "EnvConfig",
    "TabletopEnv",
    "VideoFrame",
    "make",
    "make_vec",
    "register_environments",
    "stack_actions",
]

_HOMES = {
    "VideoFrame": "tabletop",
    "TabletopEnv": "tabletop",
    "make_vec": "vector",
    "stack_actions": "action_validation",
}


def __getattr__(name: str) -> object:  # importing the environment imports MuJoCo and Numba
    if name in _HOMES:
        return getattr(importlib.import_module(f"openvima.env.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
