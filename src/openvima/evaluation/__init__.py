"""Scoring policies on the four levels, and showing what came out."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from openvima.evaluation.comparison import Comparison, compare
    from openvima.evaluation.config import EvaluationConfig
    from openvima.evaluation.merging import merge
    from openvima.evaluation.picture import save_episode_image
    from openvima.evaluation.report import write_report
    from openvima.evaluation.results import EpisodeOutcome, Results, Row
    from openvima.evaluation.runner import evaluate
    from openvima.evaluation.scoring import score
    from openvima.evaluation.statistics import wilson_interval

_HOMES = {
    "Comparison": "comparison",
    "EpisodeOutcome": "results",
    "EvaluationConfig": "config",
    "Results": "results",
    "Row": "results",
    "compare": "comparison",
    "evaluate": "runner",
    "merge": "merging",
    "save_episode_image": "picture",
    "score": "scoring",
    "wilson_interval": "statistics",
    "write_report": "report",
}

__all__ = [
    "Comparison",
    "EpisodeOutcome",
    "EvaluationConfig",
    "Results",
    "Row",
    "compare",
    "evaluate",
    "merge",
    "save_episode_image",
    "score",
    "wilson_interval",
    "write_report",
]


def __getattr__(name: str) -> object:  # films and the simulator are loaded by what needs them
    if name in _HOMES:
        return getattr(importlib.import_module(f"openvima.evaluation.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
