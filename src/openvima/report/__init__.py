"""Reports: pages and tables of evaluations, and the videos that belong to them."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from openvima.report.assets import VideoSelection, evaluate_and_report
    from openvima.report.page import write_report

__all__ = ["VideoSelection", "evaluate_and_report", "write_report"]

_MODULES = {"VideoSelection": "assets", "evaluate_and_report": "assets", "write_report": "page"}


def __getattr__(name: str) -> object:  # the simulator is imported on first use
    if name in _MODULES:
        return getattr(importlib.import_module(f"openvima.report.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
