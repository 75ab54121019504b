"""Chats with vision-language models: one wording for what a policy asks and what an export trains.

An episode is a conversation. The first message holds the prompt, with its images where they stand in the
sentence, the camera's view, and what an answer looks like; each later one holds the next view. An answer is
JSON: pick, place and rotation, or the two ends of a sweep.
"""

import base64
import hashlib
import inspect
import json
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from itertools import groupby
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from PIL import Image

from openvima.data.chat_settings import DEFAULT_ENLARGE, ChatView, Points, check_format
from openvima.errors import AnswerError, echo
from openvima.perception.objects import VIEWS, ObjectExtractor
from openvima.render.camera import CAMERAS, View, channels_last, project, unproject
from openvima.scene import END_EFFECTORS, Action, PromptImage, RenderedPrompt
from openvima.video.prompt_strip import cut_to_object

if TYPE_CHECKING:
    from openvima.data.records import Demonstration

Part = str | bytes  # a text, or an image as a PNG file
Tokens = Callable[[int, int], int]  # of an image with that width and height in pixels


class Family(NamedTuple):
    """Models that point in one way; the pattern is found in their lower-case names."""

    pattern: str
    points: Points
    image_tokens: Tokens


def _patches(side: int) -> Tokens:
    return lambda width, height: max(1, round(width / side)) * max(1, round(height / side))


def _tiles(side: int, each: int, whole: int) -> Tokens:
    return lambda width, height: whole + each * math.ceil(width / side) * math.ceil(height / side)


# Points and tokens as the makers describe them; the first that matches counts. Qwen2.5-VL means pixels of the
# image as it is resized, to multiples of 28, which 7 times the view are.
FAMILIES = (
    Family(r"qwen.?2\.?5.?vl", "pixels-xy", _patches(28)),
    Family(r"qwen.?2.?vl", "1000-xy", _patches(28)),
    Family(r"qwen", "1000-xy", _patches(32)),
    Family(r"gemini", "1000-yx", _tiles(768, 258, 0)),
    Family(r"internvl", "1000-xy", _tiles(448, 256, 256)),
    Family(r"llava|llara", "1-xy", lambda width, height: 576),
    Family(r"kimi", "1-xy", _patches(28)),
    Family(r"claude", "pixels-xy", lambda width, height: math.ceil(width * height / 750)),
    Family(r"gpt|(^|/)o\d", "pixels-xy", _tiles(512, 170, 85)),
    Family(r"", "1000-xy", _patches(28)),
)


def family_of(model: str) -> Family:
    """Return the family of a model by its name; others point as most do, 0 to 1000, x first."""
    return next(family for family in FAMILIES if re.search(family.pattern, model.lower()))


@dataclass(frozen=True)
class Turn:
    """One message of a conversation: texts and images (PNG files) in reading order."""

    role: Literal["user", "assistant"]
    parts: tuple[Part, ...]

    @cached_property
    def message(self) -> str:
        """JSON of the OpenAI-compatible protocol; made once, though every later request holds it."""
        content: list[dict[str, Any]] = []
        for part in self.parts:
            if isinstance(part, str):
                content.append({"type": "text", "text": part})
            else:
                url = f"data:image/png;base64,{base64.b64encode(part).decode('ascii')}"
                content.append({"type": "image_url", "image_url": {"url": url}})
        return json.dumps({"role": self.role, "content": content})


_SEEN_FROM = {"top": "from above", "front": "from the front"}
_SUCTION = (
    'Answer with JSON: {"pick": POINT, "place": POINT, "rotate": DEGREES}. The arm picks up what it finds at '
    '"pick", turns it clockwise as seen from above by "rotate" degrees, 0 for not at all, and puts it down '
    'so that the point that it was picked at comes to lie at "place".'
)
_SPATULA = (
    'Answer with JSON: {"from": POINT, "to": POINT}. The arm puts its spatula down at "from" and sweeps '
    'straight to "to", pushing along what is in between.'
)
_RANGES = {
    "1000": "numbers from 0 to 1000, whatever the size of the picture",
    "1": "fractions from 0 to 1 of the size of the picture",
    "pixels": "pixels of the picture, which is {width} wide and {height} high",
}
_ORDERS = {"xy": "[x, y]", "yx": "[y, x]"}
_NAMES = {"suction": ("pick", "place"), "spatula": ("from", "to")}
MOST_CHARACTERS = 20_000  # of an answer that are kept and read: its last ones
_MOST_BRACES = 200  # of which an answer's object may begin at one
_MOST = 1e9  # any number of an answer is smaller

UNREADABLE = "unreadable answer"


@dataclass(frozen=True, slots=True)
class ChatFormat:
    """How views are shown and points are written.

    Args:
        points: Largest number, 1000, 1 or "pixels", and what comes first, x or y.
        view: Camera whose picture is shown, and in which points lie; "top+front" shows the other one, too.
        enlarge: Whole factor on images, without smoothing.

    Raises:
        ConfigError: A value is not one of these.
    """

    points: Points = "1000-xy"
    view: ChatView = "top"
    enlarge: int = DEFAULT_ENLARGE

    def __post_init__(self) -> None:
        check_format(self.points, self.view, self.enlarge)

    @property
    def views(self) -> list[View]:
        """The cameras that are shown; points lie in the picture of the first."""
        return [view for view in self.view.split("+") if view in CAMERAS]  # type: ignore[misc]  # as checked

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a picture in pixels."""
        camera = CAMERAS[self.views[0]]
        return camera.width * self.enlarge, camera.height * self.enlarge

    def first_turn(
        self, prompt: RenderedPrompt, observation: Mapping, extractor: ObjectExtractor | None = None
    ) -> Turn:
        """Compose the first message of an episode; an extractor finds the objects whose boxes are listed."""
        tool = tool_in(observation)
        shown = "suction cup" if tool == "suction" else "spatula"
        parts: list[Part] = [f"You control a robot arm with a {shown} above a table. The task:"]
        parts += [part if isinstance(part, str) else self._picture(part) for part in prompt.sequence()]
        parts += self._scene(observation, extractor)
        parts += [
            _SUCTION if tool == "suction" else _SPATULA,
            f"{point_meaning(self)} A task may take several steps; answer with the next one.",
        ]
        return Turn("user", _joined(parts))

    def next_turn(self, observation: Mapping, extractor: ObjectExtractor | None = None) -> Turn:
        """Compose a later message: what the table looks like after the answer before was carried out."""
        parts: list[Part] = ["This was done. The task is not finished."]
        parts += [*self._scene(observation, extractor), "Answer with the next step, as JSON."]
        return Turn("user", _joined(parts))

    def answer(self, action: Action, tool: str) -> str:
        """Write an action as an answer, rounded to whole numbers, or to thousandths with points up to 1."""
        first, second = _NAMES[tool]
        pose0, pose1 = self.point(action.pose0_position), self.point(action.pose1_position)
        values: dict[str, Any] = {first: pose0, second: pose1}
        if tool == "suction":
            turn_rad = math.remainder(action.yaw1_rad - action.yaw0_rad, 2 * math.pi)
            values["rotate"] = round(-math.degrees(turn_rad))
        return json.dumps(values)

    def read_answer(self, text: str, tool: str) -> Action:
        """Find the action in an answer: its last JSON object that has the names of one for this tool.

        Points of the picture beside the workspace are moved into it.

        Raises:
            AnswerError: There is none, or a value cannot be.
        """
        names = _NAMES[tool]
        values = _last_object(text, names)
        points = [self._position(values[name], name) for name in names]
        turn = values.get("rotate", 0)
        if not _is_number(turn):
            raise _unreadable("rotate is no number", f"rotate is {echo(repr(turn), 60)}")
        return Action.planar(points[0], points[1], -math.radians(turn))

    def schema(self, tool: str) -> dict[str, Any]:
        """Return the JSON schema of an answer."""
        point = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
        values: dict[str, Any] = dict.fromkeys(_NAMES[tool], point)
        if tool == "suction":
            values["rotate"] = {"type": "number"}
        form = {"type": "object", "properties": values, "required": [*values]}
        return {**form, "additionalProperties": False}

    def point(self, position: Sequence[float]) -> list[float]:
        """Write a position on the table, in metres, as a point of the picture."""
        return self._written(project(np.array([*position[:2], 0.0]), CAMERAS[self.views[0]]))

    def _written(self, pixel: np.ndarray) -> list[float]:
        """Write a pixel of the view, column first, in the numbers and the order of this format."""
        numbers = (pixel + 0.5) * self._scale()
        digits = 3 if self.points.startswith("1-") else None  # whole numbers
        written = [round(number, digits) for number in numbers.tolist()]
        return written if self.points.endswith("xy") else written[::-1]

    def _scale(self) -> np.ndarray:
        """Return what a pixel of the view is in the numbers of this format: of columns, and of rows."""
        camera, largest = CAMERAS[self.views[0]], self.points.partition("-")[0]
        if largest == "pixels":
            return np.full(2, float(self.enlarge))
        return float(largest) / np.array([camera.width, camera.height])

    def _position(self, value: object, name: str) -> tuple[float, float]:
        """Read a point, in metres.

        Raises:
            AnswerError: It is not two numbers, or lies beside the picture.
        """
        if not (isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))):
            raise _unreadable("a point is not two numbers", f"{name} is {echo(repr(value), 60)}")
        numbers = np.array(value if self.points.endswith("xy") else value[::-1], np.float64)
        camera, pixel = CAMERAS[self.views[0]], numbers / self._scale()
        if not ((pixel >= 0) & (pixel <= (camera.width, camera.height))).all():
            raise _unreadable("a point beside the picture", f"{name} is {value}, points are {self.points}")
        x, y = unproject(pixel - 0.5, camera).tolist()
        return x, y

    def _scene(self, observation: Mapping, extractor: ObjectExtractor | None) -> list[Part]:
        """Show the views, and list the boxes of objects in the first."""
        parts: list[Part] = []
        for number, view in enumerate(self.views):
            parts.append(f"{'This is the table' if number == 0 else 'The same'}, seen {_SEEN_FROM[view]}:")
            parts.append(encode_picture(observation["rgb"][view], self.enlarge))
        if extractor is not None:
            parts.append(self._boxes(observation, extractor))
        return parts

    def _boxes(self, observation: Mapping, extractor: ObjectExtractor) -> str:
        found = extractor.in_observation(observation)
        view = VIEWS.index(self.views[0])
        lines = []
        for x, y, height, width in found.boxes[view, found.masks[view]].tolist():
            centre, half = np.array([x, y]), np.array([width, height]) / 2
            lines.append(json.dumps([*self._written(centre - half), *self._written(centre + half)]))
        names = "left, top, right, bottom" if self.points.endswith("xy") else "top, left, bottom, right"
        return f"Objects in it, [{names}]: {', '.join(lines) or 'none'}."

    def _picture(self, image: PromptImage) -> bytes:
        rgb = image.rgb[self.views[0]]
        if image.kind == "object":
            cut = cut_to_object(np.ascontiguousarray(channels_last(rgb)), image.segm[self.views[0]])
            rgb = np.moveaxis(cut, -1, 0)
        return encode_picture(rgb, self.enlarge)


DEFAULT_FORMAT = ChatFormat()


def point_meaning(form: ChatFormat) -> str:
    """Say in a sentence how points are written."""
    scale, _, order = form.points.partition("-")
    width, height = form.size
    where = "picture" if len(form.views) == 1 else "first of these pictures"
    numbers = _RANGES[scale].format(width=width, height=height)
    return f"A POINT is {_ORDERS[order]} in the {where}, x to the right and y down, in {numbers}."


def demo_turns(
    demo: "Demonstration", form: ChatFormat, extractor: ObjectExtractor | None = None
) -> list[Turn]:
    """Return a demonstration as a conversation: before each action a message, after it the answer."""
    turns: list[Turn] = []
    for step, action in enumerate(demo.actions):
        seen = demo.observation(step)
        asked = form.next_turn(seen, extractor) if step else form.first_turn(demo.prompt, seen, extractor)
        turns += [asked, Turn("assistant", (form.answer(action, demo.end_effector),))]
    return turns


def wording_hash() -> str:
    """Return eight hexadecimal digits of what messages are composed of: this file."""
    return hashlib.sha256(inspect.getsource(sys.modules[__name__]).encode()).hexdigest()[:8]


def encode_picture(rgb: np.ndarray, enlarge: int) -> bytes:
    """Encode an image, shape (3, H, W), uint8, as a PNG file of `enlarge` times its size, unsmoothed."""
    pixels = channels_last(rgb).repeat(enlarge, axis=0).repeat(enlarge, axis=1)
    file = BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(file, "PNG", compress_level=1)
    return file.getvalue()


def tool_in(observation: Mapping) -> str:
    """Return the end effector of an observation, "suction" or "spatula"."""
    return END_EFFECTORS[int(observation["ee"])]


def _joined(parts: Sequence[Part]) -> tuple[Part, ...]:
    """Join texts that follow one another: a model's template may put anything between two of them."""
    joined: list[Part] = []
    for kind, group in groupby(parts, type):
        found = list(group)
        joined += ["\n".join(map(str, found))] if kind is str else found
    return tuple(joined)


def _last_object(text: str, names: Sequence[str]) -> dict[str, Any]:
    tail, decoder = text[-MOST_CHARACTERS:], json.JSONDecoder()
    starts = [found.start() for found in re.finditer(r"\{", tail)][-_MOST_BRACES:]
    for start in reversed(starts):
        try:
            found, _ = decoder.raw_decode(tail, start)
        except (ValueError, RecursionError):
            continue
        if isinstance(found, dict) and set(names) <= found.keys():
            return found
    wanted = " and ".join(names)
    what = f"no JSON with {wanted}" if text.strip() else "it is empty"
    raise _unreadable(what, f"it ends with {echo(text[-60:].strip())!r}")


def _unreadable(what: str, detail: str) -> AnswerError:
    return AnswerError(f"{UNREADABLE}: {what}", detail)


def _is_number(value: object) -> bool:
    # Neither NaN nor infinity is less.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _MOST
