"""The Gymnasium environment, alone or several at once."""

from typing import TYPE_CHECKING

from openvima.env.config import EnvConfig
from openvima.env.registration import make, register_environments
from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.env.composing import SceneObject, compose
    from openvima.env.episode_file import load_episode, save_episode
    from openvima.env.tabletop import TabletopEnv, VideoFrame
    from openvima.env.vector import make_vec, stack_actions

__all__ = [
    "EnvConfig",
    "SceneObject",
    "TabletopEnv",
    "VideoFrame",
    "compose",
    "load_episode",
    "make",
    "make_vec",
    "register_environments",
    "save_episode",
    "stack_actions",
]

_HOMES = {
    "SceneObject": "composing",
    "VideoFrame": "tabletop",
    "TabletopEnv": "tabletop",
    "compose": "composing",
    "load_episode": "episode_file",
    "make_vec": "vector",
    "save_episode": "episode_file",
    "stack_actions": "vector",
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)  # importing the environment imports MuJoCo and Numba
