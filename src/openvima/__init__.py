"""Multimodal-prompt robot manipulation: a fast, deterministic VIMA-Bench and the VIMA policy family."""

from typing import TYPE_CHECKING

from openvima.env.registration import make, register_with_gymnasium

if TYPE_CHECKING:
    from openvima.env.tabletop import TabletopEnv
    from openvima.tasks import list_tasks

__version__ = "0.1.0"

__all__ = ["TabletopEnv", "__version__", "list_tasks", "make"]


def __getattr__(name: str) -> object:  # both take heavier packages with them
    if name == "TabletopEnv":
        from openvima.env.tabletop import TabletopEnv

        return TabletopEnv
    if name == "list_tasks":
        from openvima.tasks import list_tasks

        return list_tasks
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register_with_gymnasium()
