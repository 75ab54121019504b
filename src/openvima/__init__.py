"""Multimodal-prompt robot manipulation: a fast, deterministic VIMA-Bench and the VIMA policy family."""

from typing import TYPE_CHECKING

from openvima.env.registration import make, register_with_gymnasium
from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.env import SceneObject, TabletopEnv, compose, load_episode, make_vec, save_episode
    from openvima.evaluation import play
    from openvima.tasks import list_tasks

__version__ = "0.1.0"

__all__ = [
    "SceneObject",
    "TabletopEnv",
    "__version__",
    "compose",
    "list_tasks",
    "load_episode",
    "make",
    "make_vec",
    "play",
    "save_episode",
]

_HOMES = {
    "SceneObject": "env",
    "TabletopEnv": "env",
    "compose": "env",
    "list_tasks": "tasks",
    "load_episode": "env",
    "make_vec": "env",
    "play": "evaluation",
    "save_episode": "env",
}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)  # these import heavier packages

register_with_gymnasium()
