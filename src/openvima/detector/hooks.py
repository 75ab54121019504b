"""Detectors that users name in a word, for evaluations, films and training.

detector                       the one that comes with the package
detector=FOLDER                one that `openvima detector train` made
MODULE:FUNCTION                a function without arguments that gives an `ObjectExtractor`
FILE.py:FUNCTION               the same, in a file that lies anywhere
"""

import hashlib
import importlib
import importlib.util
import json
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import cast

from openvima.data.object_cache.cache import Boxes, ObjectCache, Report, open_object_cache
from openvima.data.reader import Dataset
from openvima.detector import detector_folder, load_detector, load_extractor
from openvima.errors import ConfigError
from openvima.perception.objects import ObjectExtractor, ObjectViews, see_nothing
from openvima.policies.base import WEIGHTS_FILE, checkpoint_folder
from openvima.policies.detection import DetectedObjects
from openvima.scene import PromptImage

DETECTOR = "detector"
_FORM = (
    "detector, detector=FOLDER of a trained one, or MODULE:FUNCTION or FILE.py:FUNCTION, a function without "
    "arguments that gives an ObjectExtractor"
)
_DIGEST_BYTES = 5  # of the names of folders


def extractor_maker(hook: str) -> Callable[[], object]:
    """Find the function that makes the detector.

    Args:
        hook: One of the forms above.

    Raises:
        ConfigError: There is no such module, file or function.
        CheckpointError: There is no trained detector.
    """
    folder = _folder_of(hook)
    return _function_of(hook)[1] if folder is None else partial(load_extractor, folder)


def plugged_extractor(hook: str) -> ObjectExtractor:
    """Make the detector; an observation in which it finds nothing does not stop the policy.

    Raises:
        ConfigError: There is no such function, or it gives something else.
        CheckpointError: There is no trained detector, or it is damaged.
    """
    extractor = extractor_maker(hook)()
    if not (hasattr(extractor, "in_observation") and hasattr(extractor, "in_prompt_image")):
        raise ConfigError(f"{hook} gave a {type(extractor).__name__}; it must give an ObjectExtractor.")
    return PluggedExtractor(cast(ObjectExtractor, extractor))  # it has both methods


def plugged_boxes(hook: str) -> Boxes:
    """Return the detector as what the token cache is made with.

    Its name follows from the weights and sizes of a trained detector, wherever it lies, and its least score.
    Of a function it follows from its own name and the content of its file; what else it reads is not looked
    at.

    Raises:
        ConfigError: There is no such function.
        CheckpointError: There is no trained detector, or it is damaged.
    """
    folder = _folder_of(hook)
    if folder is not None:
        detector = load_detector(folder)
        sizes, least = detector.network.config.to_dict(), DetectedObjects(detector).min_score
        weights = hashlib.blake2b((checkpoint_folder(folder) / WEIGHTS_FILE).read_bytes()).hexdigest()
        name, content = DETECTOR, json.dumps([sizes, least, weights], sort_keys=True).encode()
    else:
        module, _ = _function_of(hook)
        source, name = getattr(module, "__file__", None), hook.rpartition(":")[2]
        content = Path(source).read_bytes() if source else hook.encode()
    digest = hashlib.blake2b(content, digest_size=_DIGEST_BYTES).hexdigest()
    return Boxes(f"{name}-{digest}", partial(plugged_extractor, hook))


def detected_object_cache(
    dataset: Dataset,
    boxes: Boxes,
    *,
    folder: Path | None = None,
    workers: int = 1,
    report: Report | None = None,
) -> ObjectCache:
    """Open the tokens of the objects that a detector finds; make what is missing.

    A detector computes on one thread here, so that the files are the same for any number of workers.

    Args:
        dataset: The demonstrations.
        boxes: The detector, as from `plugged_boxes`.
        folder: As in `open_object_cache`.
        workers: As in `open_object_cache`.
        report: As in `open_object_cache`.

    Raises:
        ConfigError: The detector gives something else than it should.
        DatasetError: The folder cannot be written to.
    """

    def say(done: int, total: int, note: str) -> None:
        if report is not None:
            report(done, total, "detecting objects")

    with _one_thread():
        return open_object_cache(dataset, folder=folder, boxes=boxes, workers=workers, report=say)


@dataclass(frozen=True, slots=True)
class PluggedExtractor:
    """Shows only what some view shows, and one hidden object where a detector finds nothing.

    An episode in which nothing is found then fails, and the others go on.

    Args:
        extractor: The detector.
    """

    extractor: ObjectExtractor

    def in_observation(self, observation: Mapping) -> ObjectViews:
        """Find the objects of an observation, at least a hidden one."""
        found = _shown(self.extractor.in_observation(observation))
        return found if len(found) else see_nothing(1)

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        """Find the objects that a prompt's image shows; there may be none."""
        return _shown(self.extractor.in_prompt_image(image))


def _shown(found: ObjectViews) -> ObjectViews:
    visible = found.visible()
    return found if visible.all() else found.select(visible)


def _folder_of(hook: str) -> Path | None:
    """The folder of a trained detector; None for other hooks."""
    name, _, folder = hook.partition("=")
    return detector_folder(folder or None) if name == DETECTOR else None


def _function_of(hook: str) -> tuple[ModuleType, Callable[[], object]]:
    """The module or file that a hook names, and its function."""
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
    return module, made


def _import_file(path: Path) -> ModuleType:
    path = path.absolute()
    spec = importlib.util.spec_from_file_location(f"openvima_boxes_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise ImportError("no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _one_thread() -> AbstractContextManager[None]:
    """Keep torch to one thread, if it is there; a detector of one's own may need none."""
    try:
        from openvima.policies.devices import torch_threads
    except ImportError:
        return nullcontext()
    return torch_threads(1)
