"""Evaluating policies on the four levels."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names

if TYPE_CHECKING:
    from openvima.evaluation.comparison import Comparison, compare
    from openvima.evaluation.config import EvaluationConfig
    from openvima.evaluation.free_play import PlayResult, play
    from openvima.evaluation.merging import merge
    from openvima.evaluation.recording import save_episode_image
    from openvima.evaluation.results import EpisodeOutcome, Results, Row
    from openvima.evaluation.runner import evaluate
    from openvima.evaluation.scoring import score
    from openvima.evaluation.statistics import wilson_interval

_HOMES = {
    "Comparison": "comparison",
    "EpisodeOutcome": "results",
    "EvaluationConfig": "config",
    "PlayResult": "free_play",
    "Results": "results",
    "Row": "results",
    "compare": "comparison",
    "evaluate": "runner",
    "merge": "merging",
    "play": "free_play",
    "save_episode_image": "recording",
    "score": "scoring",
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
