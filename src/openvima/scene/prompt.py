"""Multimodal prompts: text interleaved with images of objects and scenes."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeVar

import numpy as np

from openvima.errors import PromptError, brief_repr, echo
from openvima.html import notebook_html
from openvima.scene.scene import Placement, Scene

FIRST_IMAGE_ID = 2  # after floor and sheet; prompt images show no arm
PHOTO_SIDE = 48  # pixels; rendered prompt objects have 22 to 60
PLACEHOLDER = re.compile(r"\{(\w+)\}")  # of an image, with its name

T = TypeVar("T")


def split_text(text: str, image_of: Callable[[str], T]) -> list[str | T]:
    """Split the text of a prompt at its placeholders.

    Args:
        text: The text.
        image_of: Returns what stands for the image of a name.

    Returns:
        Stripped text pieces, but for empty ones, and what stands for the images, in reading order.
    """
    pieces = enumerate(PLACEHOLDER.split(text))  # texts at even places, names at odd ones
    parts = (image_of(piece) if place % 2 else piece.strip() for place, piece in pieces)
    return [part for part in parts if part != ""]


@dataclass(frozen=True, slots=True)
class ObjectImage:
    """An image of a single object on white, in the fixed pose of prompt objects.

    Args:
        placement: The object; its pose and id are ignored.
        magnification: Factor on the whole geometry (7 for the small swept block).
    """

    placement: Placement
    magnification: float = 1.0

    def __str__(self) -> str:
        return f"{self.placement.texture} {self.placement.object}"


@dataclass(frozen=True, slots=True)
class SceneImage:
    """An image of several objects on the table, at the poses of `scene`.

    The ids are those of the image alone and count from 2; `SceneImage.of` gives them.
    """

    scene: Scene

    __repr__ = brief_repr

    def __str__(self) -> str:
        return f"scene of {', '.join(f'{p.texture} {p.object}' for p in self.scene.placements)}"

    @staticmethod
    def of(placements: Sequence[Placement]) -> "SceneImage":
        """Return an image of these objects at their poses, with ids 2, 3, … in the given order."""
        return SceneImage(Scene(tuple(replace(p, id=n) for n, p in enumerate(placements, FIRST_IMAGE_ID))))


@dataclass(frozen=True, slots=True)
class PhotoImage:
    """A picture of a single object on white that was not rendered, such as a photo.

    Args:
        width: Columns, at most 48.
        height: Rows, at most 48.
        rgb: Its pixels, `height` × `width` × 3 bytes, row 0 on top.

    Raises:
        PromptError: The picture is too large, or the pixels do not fit its size.
    """

    width: int
    height: int
    rgb: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if not (1 <= self.width <= PHOTO_SIDE and 1 <= self.height <= PHOTO_SIDE):
            raise PromptError(
                f"a photo is {self.width} × {self.height} pixels; 1 to {PHOTO_SIDE} are allowed."
            )
        if len(self.rgb) != 3 * self.width * self.height:
            raise PromptError(
                f"a photo of {self.width} × {self.height} pixels has {len(self.rgb)} bytes; "
                f"it must have {3 * self.width * self.height}."
            )

    def __str__(self) -> str:
        return f"photo of {self.width} × {self.height} pixels"

    def pixels(self) -> np.ndarray:
        """Return the picture, shape (height, width, 3), uint8."""
        return np.frombuffer(self.rgb, np.uint8).reshape(self.height, self.width, 3)


PromptFill = ObjectImage | SceneImage | PhotoImage


@dataclass(frozen=True, slots=True)
class Prompt:
    """A prompt that is not rendered yet.

    Args:
        text: The text with a placeholder for each image, such as "Put the {a} into the {b}.".
        images: Placeholder names and image contents, in the order of first appearance in the text.
        is_ambiguous: Descriptions in place of images fit objects that the images differ from, as two that
            differ in height alone.
    """

    text: str
    images: tuple[tuple[str, PromptFill], ...]
    is_ambiguous: bool = field(default=False, repr=False)  # published digests are of the repr

    __repr__ = brief_repr

    def _repr_html_(self) -> str | None:
        return notebook_html("prompt", parts=self.described_parts())

    def described_parts(self) -> list[str | tuple[str, str]]:
        """Return text pieces, and for each image its name and what it will show, in reading order."""
        shown = {name: str(fill) for name, fill in self.images}
        return split_text(self.text, lambda name: (name, shown.get(name, name)))

    @staticmethod
    def parse(template: str, **fills: PromptFill | str | int) -> "Prompt":
        """Fill the words and numbers of a template; images keep their placeholder.

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
        slots = set(PLACEHOLDER.findall(template))
        if slots != set(fills):
            raise PromptError(f"template {template!r} has slots {sorted(slots)}, but got {sorted(fills)}.")
        text = template
        fills_by_name: dict[str, PromptFill] = {}
        for name, fill in fills.items():
            if isinstance(fill, str | int):
                text = text.replace("{" + name + "}", str(fill))
            else:
                fills_by_name[name] = fill
        order = dict.fromkeys(PLACEHOLDER.findall(text))
        images = tuple((name, fills_by_name[name]) for name in order)
        return Prompt(text, images)


@dataclass(frozen=True, slots=True)
class ObjectRecord:
    """The object of one segmentation value."""

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
        segm: View name to object ids, shape (128, 256), uint8; 255 for background.
        objects: The objects in the image; floor and table are not listed.
    """

    name: str
    kind: Literal["object", "scene"]
    rgb: dict[str, np.ndarray]
    segm: dict[str, np.ndarray]
    objects: tuple[ObjectRecord, ...]

    __repr__ = brief_repr


@dataclass(frozen=True, slots=True, eq=False)
class RenderedPrompt:
    """A rendered prompt, the input of a policy.

    Args:
        text: The text with `{name}` placeholders.
        images: Placeholder name to image, in the order of first appearance in the text.
    """

    text: str
    images: dict[str, PromptImage]

    __repr__ = brief_repr

    def _repr_html_(self) -> str | None:
        return notebook_html("rendered_prompt", prompt=self)

    def sequence(self) -> list[str | PromptImage]:
        """Return the prompt as one interleaved sequence of text pieces and images, in reading order.

        Raises:
            PromptError: A placeholder has no image or an image no placeholder.
        """
        names = PLACEHOLDER.findall(self.text)
        if set(names) != set(self.images):
            raise PromptError(
                f"prompt {echo(repr(self.text), 100)} names images {echo(str(sorted(set(names))), 100)}, "
                f"but got {echo(str(sorted(self.images)), 100)}."
            )
        return split_text(self.text, self.images.__getitem__)
