"""Multimodal prompts: text interleaved with images of objects and scenes."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from openvima.errors import PromptError
from openvima.scene.scene import Placement, Scene

FIRST_IMAGE_ID = 2  # after floor and sheet; the pictures of prompts show no arm
_PLACEHOLDER = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True, slots=True)
class ObjectImage:
    """An image of one object alone on a white ground, in the pose in which prompts show objects.

    Args:
        placement: The object; its own pose and id are not used for the picture.
        magnification: Factor on the whole geometry (7 for the small swept block).
    """

    placement: Placement
    magnification: float = 1.0


@dataclass(frozen=True, slots=True)
class SceneImage:
    """An image of several objects on the table, at the poses of `scene`.

    The ids are those of the image alone and count from 2; `SceneImage.of` gives them.
    """

    scene: Scene

    @staticmethod
    def of(placements: Sequence[Placement]) -> "SceneImage":
        """Show these objects where they are, under the ids 2, 3, … in the order given.

        An object keeps its id over several images if it has the same place in each list.
        """
        return SceneImage(Scene(tuple(replace(p, id=n) for n, p in enumerate(placements, FIRST_IMAGE_ID))))


PromptFill = ObjectImage | SceneImage


@dataclass(frozen=True, slots=True)
class Prompt:
    """What the robot is told, before anything is rendered.

    Args:
        text: The sentence; each image stands in it as its placeholder, such as "Put the {a} into the {b}.".
        images: Placeholder names and what their images show, in the order of first appearance in the text.
    """

    text: str
    images: tuple[tuple[str, PromptFill], ...]

    @staticmethod
    def parse(template: str, **fills: PromptFill | str | int) -> "Prompt":
        """Fill a template: words and numbers are written into the text, images keep their placeholder.

        Args:
            template: Text with `{name}` for each slot.
            **fills: For each slot a word, a number or an image.

        Returns:
            The prompt.

        Raises:
            PromptError: The slots of the template are not exactly the names given.

        Example:
            >>> Prompt.parse("Turn by {angle} degrees.", angle=30).text
            'Turn by 30 degrees.'
        """
        slots = set(_PLACEHOLDER.findall(template))
        if slots != set(fills):
            raise PromptError(f"template {template!r} has slots {sorted(slots)}, but got {sorted(fills)}.")
        text = template
        shown: dict[str, PromptFill] = {}
        for name, fill in fills.items():
            if isinstance(fill, str | int):
                text = text.replace("{" + name + "}", str(fill))
            else:
                shown[name] = fill
        order = dict.fromkeys(_PLACEHOLDER.findall(text))
        images = tuple((name, shown[name]) for name in order)
        return Prompt(text, images)


@dataclass(frozen=True, slots=True)
class ObjectRecord:
    """Which object the pixels of one segmentation value show."""

    object_id: int
    object: str
    texture: str


@dataclass(frozen=True, slots=True, eq=False)
class PromptImage:
    """The rendered image of one placeholder.

    Args:
        name: The placeholder's name.
        kind: "object" (one object on white) or "scene" (objects on the table).
        rgb: View name to image, shape (3, 128, 256), uint8.
        segm: View name to object ids, shape (128, 256), uint8; 255 where nothing is.
        objects: The objects shown; floor and table are not listed.
    """

    name: str
    kind: Literal["object", "scene"]
    rgb: dict[str, np.ndarray]
    segm: dict[str, np.ndarray]
    objects: tuple[ObjectRecord, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RenderedPrompt:
    """A prompt as a policy receives it.

    Args:
        text: The sentence with `{name}` placeholders.
        images: Placeholder name to image, in the order of first appearance in the text.
    """

    text: str
    images: dict[str, PromptImage]

    def sequence(self) -> list[str | PromptImage]:
        """Return the prompt as one interleaved sequence of text pieces and images, in reading order.

        Raises:
            PromptError: A placeholder has no image or an image no placeholder.
        """
        names = _PLACEHOLDER.findall(self.text)
        if set(names) != set(self.images):
            raise PromptError(
                f"prompt {self.text!r} names images {sorted(set(names))}, but got {sorted(self.images)}."
            )
        pieces = _PLACEHOLDER.split(self.text)  # text at even places, names at odd ones
        parts = [self.images[piece] if i % 2 else piece.strip() for i, piece in enumerate(pieces)]
        return [part for part in parts if not isinstance(part, str) or part]
