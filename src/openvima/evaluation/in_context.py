"""In-context evaluation: prompts of three tasks, edited to contain an example, as inverse dynamics does.

| task | edited prompt |
|---|---|
| `twist` | "Follow this motion: {before} {after} for all red swirl objects." |
| `follow_motion` | "Follow this motion for {object}: {frames}.", its own prompt |
| `follow_order` | "Follow this motion: {frames}." |

All images are those of the task's own prompt, of `twist` the first pair. Episodes stay the same. Policies
are trained without these tasks.

Source: MIDAS (Li et al. 2023); which pair of `twist` it shows is not published.
"""

import re
from collections.abc import Callable, Mapping
from types import MappingProxyType

from openvima.errors import ConfigError, PromptError, echo, unknown_name
from openvima.scene import RenderedPrompt
from openvima.tasks import twist
from openvima.training.augmentation.prompts import MOTION_TEXT

_MAX_SHOWN = 100  # characters of a prompt in an error
_TEXTURE = re.compile(
    re.escape(twist.TEMPLATE.partition("{examples} ")[2]).replace(r"\{twist_obj_texture\}", "(.+)")
)


def in_context_prompt(prompt: RenderedPrompt, task: str) -> RenderedPrompt:
    """Edit a prompt for in-context evaluation.

    Args:
        prompt: The task's own prompt.
        task: Name of the task.

    Raises:
        ConfigError: The task has no edited prompt.
        PromptError: The prompt is not one of that task.
    """
    if problem := no_edited_prompt(task):
        raise ConfigError(problem)
    names = tuple(prompt.images)
    text, shown = _EDITS[task](prompt.text, names)
    return RenderedPrompt(text, {name: prompt.images[name] for name in shown})


def no_edited_prompt(task: str) -> str:
    """Return why a task has no in-context evaluation; empty if it has one."""
    if task in IN_CONTEXT_TASKS:
        return ""
    return unknown_name("in-context evaluation of task", task, IN_CONTEXT_TASKS)


_Edited = tuple[str, tuple[str, ...]]  # text, and names of the images in it


def _twist(text: str, names: tuple[str, ...]) -> _Edited:
    found = _TEXTURE.search(text)
    if found is None or len(names) < 2:
        raise PromptError(f"{echo(repr(text), _MAX_SHOWN)} is no prompt of twist; it has no pair of images.")
    before, after = names[:2]
    return f"Follow this motion: {{{before}}} {{{after}}} for all {found[1]} objects.", (before, after)


def _follow_motion(text: str, names: tuple[str, ...]) -> _Edited:
    return text, names


def _follow_order(text: str, names: tuple[str, ...]) -> _Edited:
    return MOTION_TEXT.format(frames=" ".join(f"{{{name}}}" for name in names)), names


_EDITS: Mapping[str, Callable[[str, tuple[str, ...]], _Edited]] = MappingProxyType(
    {"twist": _twist, "follow_motion": _follow_motion, "follow_order": _follow_order}
)
IN_CONTEXT_TASKS = tuple(_EDITS)
