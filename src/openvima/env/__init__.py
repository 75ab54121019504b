"""The Gymnasium environment, alone or several at once."""

from typing import TYPE_CHECKING

from openvima.env.config import EnvConfig
from openvima.env.registration import make, register_environments
from openvima.lazy import lazy_names

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

__getattr__, __dir__ = lazy_names(__name__, _HOMES)  # importing the environment imports MuJoCo and Numba
