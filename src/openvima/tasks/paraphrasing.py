"""Other phrasings of a task's prompt: lists of templates in YAML files, and how a prompt gets one."""

import re
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources

from openvima.input_files import read_yaml
from openvima.scene.prompt import PLACEHOLDER

Phrasings = Mapping[str, tuple[str, ...]]


def training_paraphrases() -> Phrasings:
    """Return the paraphrases that training may use, by task."""
    return read_phrasings("openvima.tasks", "paraphrases.yaml")


@lru_cache
def read_phrasings(package: str, name: str) -> Phrasings:
    """Read a file of this package: task to templates, with the slots of the task's own template."""
    with resources.as_file(resources.files(package).joinpath(name)) as path:
        return {task: tuple(templates) for task, templates in read_yaml(path).items()}


def rephrased(text: str, template: str, phrasing: str) -> str | None:
    """Return the text of a prompt in another phrasing.

    Args:
        text: The text; images keep their placeholders, or descriptions are in place of them.
        template: The template that it follows, such as "Rotate the {dragged_obj} {angle} degrees."; a slot
            that occurs twice has one value.
        phrasing: Another template with the same slots.

    Returns:
        The text; None where it does not follow the template.

    Example:
        >>> rephrased("Rotate the {a} 30 degrees.", "Rotate the {x} {n} degrees.", "Turn the {x} by {n}.")
        'Turn the {a} by 30.'
    """
    found = _pattern(template).fullmatch(text)
    return None if found is None else PLACEHOLDER.sub(lambda slot: found[slot[1]], phrasing)


@lru_cache
def _pattern(template: str) -> re.Pattern[str]:
    pattern, known = "", set[str]()
    for place, piece in enumerate(PLACEHOLDER.split(template)):
        if not place % 2:
            pattern += re.escape(piece)
        elif piece in known:
            pattern += f"(?P={piece})"
        else:
            # Greedy: of "the red letter A 30 degrees" the first slot takes all words but the last. An adverb
            # may be empty: "the {adv}{novel_adj} {dragged_obj}".
            pattern += f"(?P<{piece}>.*)"
            known.add(piece)
    return re.compile(pattern)
