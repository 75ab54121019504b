"""Evaluating policies on the four levels."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.evaluation.comparison import Comparison, compare, merge
    from openvima.evaluation.config import EvaluationConfig
    from openvima.evaluation.recording import save_episode_image
    from openvima.evaluation.results import EpisodeOutcome, Results, Row
    from openvima.evaluation.runner import evaluate, score
    from openvima.evaluation.session import PlayResult, play
    from openvima.evaluation.statistics import wilson_interval

_HOMES = {
    "Comparison": "comparison",
    "EpisodeOutcome": "results",
    "EvaluationConfig": "config",
    "PlayResult": "session",
    "Results": "results",
    "Row": "results",
    "compare": "comparison",
    "evaluate": "runner",
    "merge": "comparison",
    "play": "session",
    "save_episode_image": "recording",
    "score": "runner",
    "wilson_interval": "statistics",
}

__all__ = [
    "Comparison",
    "EpisodeOutcome",
    "EvaluationConfig",
    "PlayResult",
    "Results",
    "Row",
    "compare",
    "evaluate",
    "merge",
    "play",
    "save_episode_image",
    "score",
    "wilson_interval",
]

__getattr__, __dir__ = lazy_names(__name__, _HOMES)  # the simulator is imported on first use
