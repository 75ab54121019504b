"""Reports: pages and tables of evaluations, and the videos that belong to them."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.report.page import write_report
    from openvima.report.videos import VideoSelection, evaluate_and_report

__all__ = ["VideoSelection", "evaluate_and_report", "write_report"]

_MODULES = {"VideoSelection": "videos", "evaluate_and_report": "videos", "write_report": "page"}

__getattr__, __dir__ = lazy_names(__name__, _MODULES)  # the simulator is imported on first use
