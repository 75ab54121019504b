"""Studies: experiments of several runs, each a list of runs as data, ending in one page."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names
from openvima.studies.study import (
    Demonstrations,
    EvaluationSettings,
    PublishedPoint,
    Run,
    Scale,
    Study,
    StudyInputs,
    published_points,
    scale_named,
)

if TYPE_CHECKING:
    from openvima.studies.library import STUDIES, check_options, make_study
    from openvima.studies.runner import run_study

__all__ = [
    "STUDIES",
    "Demonstrations",
    "EvaluationSettings",
    "PublishedPoint",
    "Run",
    "Scale",
    "Study",
    "StudyInputs",
    "check_options",
    "make_study",
    "published_points",
    "run_study",
    "scale_named",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "run_study": "runner",
        "STUDIES": "library",
        "check_options": "library",
        "make_study": "library",
    },
)
