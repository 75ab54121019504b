"""Multimodal-prompt robot manipulation: a fast, deterministic VIMA-Bench and the VIMA policy family."""

from typing import TYPE_CHECKING

from openvima.env.registration import make, register_with_gymnasium
from openvima.lazy import lazy_names

if TYPE_CHECKING:
    from openvima.env import TabletopEnv, make_vec
    from openvima.tasks import list_tasks

__version__ = "0.1.0"

__all__ = ["TabletopEnv", "__version__", "list_tasks", "make", "make_vec"]

_HOMES = {"TabletopEnv": "env", "make_vec": "env", "list_tasks": "tasks"}

__getattr__, __dir__ = lazy_names(__name__, _HOMES)  # these import heavier packages

register_with_gymnasium()
