"""The studies by name, and those of users."""

from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType

from openvima.errors import ConfigError, unknown_name
from openvima.studies.study import Study, StudyInputs
from openvima.user_code import is_code, load_function

# Name → what it asks. Each is a function of the same name in a module of the same name, with underscores.
STUDIES: Mapping[str, str] = MappingProxyType(
    {
        "data-scaling": "success by the fraction of the demonstrations",
    }
)


def make_study(name: str, inputs: StudyInputs) -> Study:
    """Return a study.

    Args:
        name: One of `STUDIES`, or FILE.py:FUNCTION or MODULE:FUNCTION, a function of `StudyInputs`.
        inputs: Scale and options.

    Raises:
        ConfigError: There is no such study, it lacks an option, or the function returns something else.
    """
    if is_code(name):
        study = load_function(name, what="study")(inputs)
        if not isinstance(study, Study):
            raise ConfigError(f"study is {name!r}, which returned a {type(study).__name__}; return a Study.")
        return study
    if name not in STUDIES:
        raise ConfigError(unknown_name("study", name, STUDIES))
    module = name.replace("-", "_")
    return getattr(import_module(f"openvima.studies.{module}"), module)(inputs)
