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
        "model-scaling": "success by the size of the network, all architectures",
        "data-scaling": "success by the fraction of the demonstrations",
        "image-tokens": "objects, perceivers, patches or one token",
        "conditioning": "cross-attention to the prompt, or the prompt as a prefix",
        "text-encoder": "sizes of T5, and how many of its layers are trained",
        "distractors": "success of policies by the number of distractors",
        "corrupted-prompts": "success of policies with masked, swapped or replaced words",
        "level-drop": "from L1 to L4, by architecture",
        "midas": "autoregressive actions, visual residual, pretraining",
        "in-context": "examples in prompts of tasks left out of the training",
        "published": "a public checkpoint with the original assets, beside its published numbers",
    }
)

# Options that not every study takes.
_TAKERS = {"policy": ("distractors", "corrupted-prompts"), "checkpoint": ("published",)}


def check_options(name: str, inputs: StudyInputs) -> None:
    """Check that a study takes the options; those of users take all.

    Raises:
        ConfigError: An option has no effect on the study.
    """
    given = {"policy": inputs.policies, "checkpoint": inputs.checkpoint}
    for option, takers in _TAKERS.items():
        if given[option] and name in STUDIES and name not in takers:
            raise ConfigError(f"study {name!r} takes no --{option}; {' and '.join(takers)} do.")
    if inputs.t5 is not None and inputs.scale.is_nano and name in STUDIES:
        raise ConfigError("scale nano has its own vocabulary and no T5; leave --t5 out.")


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
