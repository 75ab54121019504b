"""Boxes from a plugged-in detector, for the control `detected_boxes`."""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import cast

from openvima.detection import detector_folder
from openvima.detection import load_finder as load_detecting_finder
from openvima.errors import ConfigError
from openvima.perception.objects import ObjectFinder, ObjectViews, see_nothing
from openvima.scene import PromptImage

DETECTOR = "detector"  # the one that comes with the package; or detector=FOLDER
_FORM = (
    "detector, detector=FOLDER of a trained one, or MODULE:FUNCTION or FILE.py:FUNCTION, a function without "
    "arguments that gives an ObjectFinder"
)


def finder_maker(hook: str) -> Callable[[], object]:
    """Find the function that makes the detector.

    Args:
        hook: "detector" for the one that comes with the package, "detector=folder" for another trained one;
            "module:function", or "file.py:function" for a file that lies anywhere.

    Raises:
        ConfigError: There is no such module, file or function.
        CheckpointError: There is no trained detector.
    """
    name, _, folder = hook.partition("=")
    if name == DETECTOR:
        return partial(load_detecting_finder, detector_folder(folder or None))
    where, _, name = hook.rpartition(":")
    if not where or not name:
        raise ConfigError(f"boxes is {hook!r}; give {_FORM}.")
    try:
        module = _import_file(Path(where)) if where.endswith(".py") else importlib.import_module(where)
    except (ImportError, OSError) as error:
        raise ConfigError(f"boxes is {hook!r}, but {where} cannot be imported ({error}).") from error
    made = getattr(module, name, None)
    if not callable(made):
        raise ConfigError(f"boxes is {hook!r}, but {where} has no function {name!r}; give {_FORM}.")
    return made


def load_finder(hook: str) -> ObjectFinder:
    """Make the detector; an observation in which it finds nothing does not stop the policy.

    Raises:
        ConfigError: There is no such function, or it gives something else.
        CheckpointError: There is no trained detector, or it is damaged.
    """
    finder = finder_maker(hook)()
    if not (hasattr(finder, "in_observation") and hasattr(finder, "in_prompt_image")):
        raise ConfigError(f"{hook} gave a {type(finder).__name__}; it must give an ObjectFinder.")
    return _NeverEmpty(cast(ObjectFinder, finder))  # it has both methods


@dataclass(frozen=True, slots=True)
class _NeverEmpty:
    """Shows one hidden object where none is found: the episode then fails, and the others go on."""

    finder: ObjectFinder

    def in_observation(self, observation: Mapping) -> ObjectViews:
        found = self.finder.in_observation(observation)
        return found if len(found) else see_nothing(1)

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        return self.finder.in_prompt_image(image)


def _import_file(path: Path) -> ModuleType:
    path = path.absolute()
    spec = importlib.util.spec_from_file_location(f"openvima_boxes_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError("no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
