"""Studies: experiments of several runs, each a list of runs as data, ending in one page."""

from typing import TYPE_CHECKING

from openvima.imports import lazy_names
from openvima.studies.scales import SCALES, Scale, scale_named
from openvima.studies.study import (
    Demonstrations,
    EvaluationSettings,
    PublishedPoint,
    Run,
    Study,
    StudyInputs,
    published_points,
)

if TYPE_CHECKING:
    from openvima.studies.registry import STUDIES, check_options, make_study
    from openvima.studies.runner import Execution, run_study

__all__ = [
    "SCALES",
    "STUDIES",
    "Demonstrations",
    "EvaluationSettings",
    "Execution",
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
        "Execution": "runner",
        "run_study": "runner",
        "STUDIES": "registry",
        "check_options": "registry",
        "make_study": "registry",
    },
)
