"""Settings of chats with vision-language models; apart, so that the command line starts without the rest."""

from dataclasses import dataclass
from typing import Literal, get_args

from openvima.errors import ConfigError, unknown_name

Points = Literal["1000-xy", "1000-yx", "1-xy", "1-yx", "pixels-xy", "pixels-yx"]
POINTS: tuple[Points, ...] = get_args(Points)
ChatView = Literal["top", "front", "top+front", "front+top"]
CHAT_VIEWS: tuple[ChatView, ...] = get_args(ChatView)
DEFAULT_ENLARGE = 4
SEGMENTATION = "segmentation"  # where boxes come from, in place of a detector


def check_format(points: str, view: str, enlarge: int) -> None:
    """Check how views are shown and points are written, see `ChatFormat`.

    Raises:
        ConfigError: A value is not allowed.
    """
    for name, value, allowed in (("points", points, POINTS), ("view", view, CHAT_VIEWS)):
        if value not in allowed:
            raise ConfigError(unknown_name(f"choice of {name}", value, allowed))
    if not 1 <= enlarge <= 16:
        raise ConfigError(f"enlarge is {enlarge}; it must lie within 1 … 16.")


@dataclass(frozen=True, slots=True)
class VlmOptions:
    """How a vision-language model is asked.

    Args:
        points: How it writes points: largest number (1000, 1, or pixels) and order, such as 1000-xy.
            Default: by the family of its name, such as 1000-yx for Gemini.
        enlarge: Whole factor on images, without smoothing.
        boxes: List boxes of the objects in the text: segmentation; detector, the bundled one, or what else
            --boxes takes.
        shots: Number of demonstrations of the same task, of domain train, before it; tasks that are held out
            for L4 get none.
        free_text: Ask for no JSON by a schema, so that models may think aloud before.
        temperature: Of sampling, where the server takes one; a negative one leaves it to the server.
        concurrency: Requests at a time.
        max_requests: End with the finished part of the table after so many requests; 0: no limit.
        max_tokens: The same for tokens, in and out; 0: no limit.

    Raises:
        ConfigError: A value is out of its range.
    """

    points: Points | None = None
    enlarge: int = DEFAULT_ENLARGE
    boxes: str = ""
    shots: int = 0
    free_text: bool = False
    temperature: float = 0.0
    concurrency: int = 16
    max_requests: int = 0
    max_tokens: int = 0

    def __post_init__(self) -> None:
        check_format(self.points or POINTS[0], CHAT_VIEWS[0], self.enlarge)
        for name, least in (("shots", 0), ("concurrency", 1), ("max_requests", 0), ("max_tokens", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"vlm.{name} is {getattr(self, name)}; it must be at least {least}.")


DEFAULT_OPTIONS = VlmOptions()
