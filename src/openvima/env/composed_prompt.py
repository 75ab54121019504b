"""Prompts of composed episodes: images of objects, scenes and photos from what users give."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any  # of whatever type a user gives; checked here

from openvima.catalog import object_spec
from openvima.env.checked_values import entries, handles_hint, known_object, odd_character, shown
from openvima.env.composed_objects import (
    FIELDS,
    SceneObject,
    check_inside,
    checked_appearance,
    put,
    scene_object,
)
from openvima.errors import InputFileError, SceneError, unknown_name
from openvima.perception.objects import MAX_OBJECTS
from openvima.perception.preprocessing import image_names
from openvima.scene import ObjectImage, PhotoImage, Placement, Pose, Prompt, PromptFill, SceneImage
from openvima.tasks.sweep_table import MAGNIFICATION
from openvima.tasks.table import TableSampler

MAX_PROMPT_CHARS = 1000
MAX_IMAGES = 64
SMALL_BLOCK = "small block"


@dataclass(frozen=True, slots=True)
class ImageMaker:
    """Makes prompt images of what users give.

    Args:
        handles: Objects of the scene.
        table: Sampler of the scene.
        photo: Reads a PNG file.
    """

    handles: Mapping[str, Placement]
    table: TableSampler
    photo: Callable[[str], PhotoImage]

    def fill(self, slot: str, given: object) -> PromptFill:
        """Make the image of one placeholder.

        Raises:
            SceneError: It is none of the allowed forms.
        """
        label = f"image {slot!r}"
        if isinstance(given, ObjectImage | SceneImage | PhotoImage):
            return given
        if isinstance(given, Path) or (isinstance(given, str) and given.lower().endswith(".png")):
            try:
                return self.photo(str(given))
            except InputFileError as error:
                raise InputFileError(f"{label}: {error}") from None
        if isinstance(given, str) or type(given) is int:
            return _object_image(known_object(given, self.handles, label))
        if isinstance(given, Mapping):
            if set(given) != {"object", "texture"}:
                names = shown(sorted(map(str, given)))
                raise SceneError(f"{label} has fields {names}; allowed are object and texture.")
            return self._from_catalogue(given["object"], given["texture"], label)
        parts = entries(given, label)
        if len(parts) == 2 and all(isinstance(part, str) for part in parts):
            return self._from_catalogue(parts[0], parts[1], label)
        if not 1 <= len(parts) <= MAX_OBJECTS:
            raise SceneError(f"{label} shows {len(parts)} objects; a scene has 1 to {MAX_OBJECTS}.")
        return self._scene(parts, label)

    def _from_catalogue(self, object_name: object, texture: object, label: str) -> ObjectImage:
        known, known_texture = checked_appearance(object_name, texture, label)
        pose = Pose.planar(0.5, 0.0)
        return _object_image(Placement(0, known, known_texture, object_spec(known).size_max, pose))

    def _scene(self, listed: Sequence[Any], label: str) -> SceneImage:
        """Place objects on an empty table; what overlaps lies on top."""
        table = self.table.blank()
        for n, entry in enumerate(listed):
            given = self._moved(entry, f"{label}, object {n}")
            placed = put(table, given, on_top=True)
            check_inside(placed, table.assets, f"{label}, object {n} ({given.texture} {given.object})")
        return SceneImage.of(table.placements)

    def _moved(self, entry: object, label: str) -> SceneObject:
        """Read an object of a prompt scene: one of its own, or one of the scene at another position."""
        is_moved = (
            isinstance(entry, Sequence)
            and not isinstance(entry, str)
            and 2 <= len(entry) <= 3
            and not isinstance(entry[1], str)
        )
        if not is_moved:
            return scene_object(entry, label, "")
        handle, position, *yaw = entry  # type: ignore[misc]  # a sequence, as checked
        known = known_object(handle, self.handles, label)
        yaw_deg = yaw[0] if yaw else math.degrees(known.pose.yaw_rad)
        moved = (known.object, known.texture, position, yaw_deg)
        values = dict(zip(FIELDS[:4], moved, strict=True))
        return scene_object({**values, "scale": known.scale[0]}, label, "")


def _object_image(placement: Placement) -> ObjectImage:
    return ObjectImage(placement, MAGNIFICATION if placement.object == SMALL_BLOCK else 1.0)


def _checked_text(text: object) -> str:
    """Return a text in one line: other blanks than the space, such as ends of lines, become one."""
    if isinstance(text, str) and len(text) <= 2 * MAX_PROMPT_CHARS and not text.isprintable():
        text = " ".join(text.split())
    if not isinstance(text, str) or not text.strip() or len(text) > MAX_PROMPT_CHARS:
        raise SceneError(
            f"prompt is {shown(text)}; give 1 to {MAX_PROMPT_CHARS} characters, not blanks alone, such as "
            "'Put the {a} into the {b}.'"
        )
    if odd := odd_character(text):
        raise SceneError(
            f"prompt is {shown(text)}, with the character {odd}, which is not for text; leave it out."
        )
    return text


def composed_prompt(text: object, images: object, fills: ImageMaker) -> Prompt:
    """Make a prompt of its text and the images that a user gives.

    Raises:
        SceneError: The text or an image is malformed, or a placeholder has no image.
        UnknownObjectError, UnknownTextureError, InputFileError: As for `compose`.
    """
    text = _checked_text(text)
    if not isinstance(images, Mapping | None):
        raise SceneError(f"images is {shown(images)}; give a mapping of placeholders to images.")
    slots = image_names(text)
    if len(slots) > MAX_IMAGES:
        raise SceneError(f"the prompt has {len(slots)} placeholders; at most {MAX_IMAGES} are allowed.")
    given = dict(images or {})
    if unused := [name for name in given if name not in slots]:
        raise SceneError(unknown_name("placeholder in the prompt for image", unused[0], slots))
    for slot in slots:
        if slot not in given and slot not in fills.handles:
            what = "image or object for placeholder"
            raise SceneError(unknown_name(what, slot, fills.handles, handles_hint(fills.handles)))
    return Prompt(text, tuple((slot, fills.fill(slot, given.get(slot, slot))) for slot in slots))
