"""Object extractors by name, for the option `--boxes` of evaluation, demo and training.

detector                       the bundled detector
detector=FOLDER                a detector trained with `openvima detector train`
MODULE:FUNCTION                a function without arguments that returns an `ObjectExtractor`
FILE.py:FUNCTION               the same, from a Python file
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from openvima.data.chat_settings import SEGMENTATION
from openvima.data.object_cache import Boxes, ObjectCache, open_object_cache
from openvima.data.reader import Dataset
from openvima.detector import detector_folder, load_detector, load_extractor
from openvima.detector.detection import MATCHING_VERSION, DetectedObjects
from openvima.errors import ConfigError
from openvima.perception.objects import (
    GROUND_TRUTH,
    AheadExtractor,
    ObjectExtractor,
    ObjectViews,
    make_hidden_objects,
)
from openvima.policies.base import torch_threads
from openvima.policies.naming import WEIGHTS_FILE, checkpoint_folder
from openvima.scene import PromptImage
from openvima.user_code import call_function, is_code, source_hash

DETECTOR = "detector"
_FORM = (
    "detector, detector=FOLDER of a trained one, or MODULE:FUNCTION or FILE.py:FUNCTION, a function without "
    "arguments that returns an ObjectExtractor"
)
_DIGEST_BYTES = 5  # in cache folder names


def plugged_extractor(source: str) -> ObjectExtractor:
    """Make an extractor that tolerates observations without detections.

    Args:
        source: One of the forms above.

    Raises:
        ConfigError: There is no such module, file or function, or the function returns something else.
        InputFileError: There is no trained detector, or it is damaged.
    """
    if (folder := _folder_of(source)) is not None:
        return PluggedExtractor(load_extractor(folder))
    extractor = call_function(source, what="boxes")
    if not (hasattr(extractor, "in_observation") and hasattr(extractor, "in_prompt_image")):
        raise ConfigError(
            f"{source} returned a {type(extractor).__name__}; it must return an ObjectExtractor."
        )
    return PluggedExtractor(extractor)


def chat_extractor(boxes: str) -> ObjectExtractor | None:
    """Return what finds the objects that a chat lists: "segmentation", a form above, or "" for none."""
    if boxes == SEGMENTATION:
        return GROUND_TRUTH
    return plugged_extractor(boxes) if boxes else None


def plugged_boxes(source: str, *, fraction: float = 1.0) -> Boxes:
    """Return an extractor as the source of boxes for the object cache.

    Args:
        source: One of the forms above.
        fraction: Fraction of the demonstrations that the cache holds.

    The cache name of a trained detector is a hash of its weights, config and score threshold. That of a
    function is a hash of its source file; other files that it reads are not hashed.

    Raises:
        ConfigError: There is no such function.
        InputFileError: There is no trained detector, or it is damaged.
    """
    folder = _folder_of(source)
    if folder is not None:
        detector = load_detector(folder)
        sizes, least = detector.network.config.to_dict(), DetectedObjects(detector).min_score
        weights = hashlib.blake2b((checkpoint_folder(folder) / WEIGHTS_FILE).read_bytes()).hexdigest()
        values = [sizes, least, MATCHING_VERSION, weights]
        name, content = DETECTOR, json.dumps(values, sort_keys=True).encode()
    else:
        name, content = source.rpartition(":")[2], source_hash(source, what="boxes").encode()
    digest = hashlib.blake2b(content, digest_size=_DIGEST_BYTES).hexdigest()
    return Boxes(f"{name}-{digest}", partial(plugged_extractor, source), fraction)


def detected_object_cache(dataset: Dataset, boxes: Boxes, **options: Any) -> ObjectCache:
    """Open the object cache of a detector and fill in missing files.

    The detector computes on one thread, so that the files do not depend on the number of workers.

    Args:
        dataset: The demonstrations.
        boxes: The detector, from `plugged_boxes`.
        **options: Others of `open_object_cache`.

    Raises:
        ConfigError: The detector returns something else than objects.
        DatasetError: The folder is not writable.
        FolderLockedError: Another process writes the cache.
    """
    with torch_threads(1):
        return open_object_cache(dataset, boxes=boxes, **options)


@dataclass(frozen=True, slots=True)
class PluggedExtractor:
    """Keeps visible objects only, and returns one masked object where nothing is detected.

    An episode without detections then fails without stopping the others.

    Args:
        extractor: The wrapped extractor.
    """

    extractor: ObjectExtractor

    def in_observation(self, observation: Mapping) -> ObjectViews:
        """Extract the objects of an observation, at least one masked object."""
        found = self.extractor.in_observation(observation)
        found = found.select(found.visible())
        return found if len(found) else make_hidden_objects(1)

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        """Extract the objects of a prompt image; there may be none."""
        found = self.extractor.in_prompt_image(image)
        return found.select(found.visible())

    def extract_ahead(self, observations: Sequence[Mapping], images: Sequence[PromptImage]) -> None:
        """Pass on images to an extractor that can process them together."""
        if isinstance(self.extractor, AheadExtractor):
            self.extractor.extract_ahead(observations, images)


def _folder_of(source: str) -> Path | None:
    """The folder of a trained detector; None for a function.

    Raises:
        ConfigError: The source has none of the forms.
        InputFileError: There is no such folder.
    """
    name, _, folder = source.partition("=")
    if name == DETECTOR:
        return detector_folder(folder or None)
    if not is_code(source):
        raise ConfigError(f"boxes is {source!r}; give {_FORM}.")
    return None
