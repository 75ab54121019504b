"""Text prompts: descriptions such as "the red swirl letter A" in place of object images."""

import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib import resources

import numpy as np

from openvima.catalog import NEUTRAL_TEXTURE, OBJECTS
from openvima.catalog.objects import REGISTERED_OBJECTS
from openvima.errors import ConfigError, PromptError, echo, unknown_name
from openvima.input_files import read_yaml
from openvima.scene import ObjectImage, ObjectRecord, Placement, Prompt, RenderedPrompt, Scene
from openvima.scene.prompt import PLACEHOLDER

MULTIMODAL = "multimodal"
PROMPTS = (MULTIMODAL, "text", "mixed", "text,paraphrased", "mixed,paraphrased")
"""Forms of prompts: published; all object images described; each with probability ½; with synonyms."""

_REPLACED_PROB = 0.5  # of an object image in mixed prompts
_MAX_NAMES = 200  # characters of object and texture that others send
_INTRODUCED = re.compile(r"\bis an? [\w-]+ $")  # "This is a wug {image}."
_ARTICLE = re.compile(r"\b([Aa])n? $")
_PLURAL = re.compile(r"\b(two|three|four|five|six|all|both|some|\d+) $", re.IGNORECASE)
_DETERMINED = re.compile(  # "the {image}", "the same {image}", "the less kobar {image}", "any {image}"
    r"\b(the( less| more)?( [\w-]+)?|this|that|each|every|any|one) $", re.IGNORECASE
)
_VOWEL = re.compile(r"[aeiou]|[AEFHILMNORSX](?![A-Za-z])")  # as it sounds: "an L-shaped block"


def check_prompts(prompts: str) -> None:
    """Check a form of prompts.

    Raises:
        ConfigError: It is none of `PROMPTS`.
    """
    if prompts not in PROMPTS:
        allowed = f"Allowed: {'; '.join(PROMPTS)}."
        raise ConfigError(unknown_name("form of prompts", prompts, PROMPTS, allowed))


def rewrite(prompt: Prompt, scene: Scene, prompts: str, rng: np.random.Generator) -> Prompt:
    """Replace object images of a prompt by descriptions: texture and name.

    Images of scenes stay. Images of a shape alone, which are gray, are described by the name alone.

    Args:
        prompt: The multimodal prompt.
        scene: The objects on the table; they decide whether the descriptions are ambiguous.
        prompts: One of `PROMPTS`.
        rng: Generator of the choices. Equal ones choose the same images with and without synonyms.

    Returns:
        The prompt with the remaining images, marked where its words are ambiguous.

    Example:
        >>> rewrite(prompt, scene, "text", rng).text  # doctest: +SKIP
        'Put the red swirl letter A into the blue bowl.'
    """
    shown = {name: fill.placement for name, fill in prompt.images if isinstance(fill, ObjectImage)}
    text, nouns = _described(prompt.text, [name for name, _ in prompt.images], shown, prompts, rng)
    return replace(
        prompt,
        text=text,
        images=tuple((name, fill) for name, fill in prompt.images if name not in nouns),
        is_ambiguous=any(_is_ambiguous(shown[n], noun, shown.values(), scene) for n, noun in nouns.items()),
    )


def describe(prompt: RenderedPrompt, prompts: str) -> RenderedPrompt:
    """Replace object images of a rendered prompt by descriptions, as `rewrite` does before rendering.

    Args:
        prompt: The prompt. Equal ones give equal choices.
        prompts: One of `PROMPTS`.

    Raises:
        PromptError: A name is too long.
    """
    if prompts == MULTIMODAL:
        return prompt
    records = {name: image.objects for name, image in prompt.images.items()}
    rng = np.random.default_rng(zlib.crc32(repr((prompt.text, records)).encode()))
    shown = {
        name: objects[0]
        for name, objects in records.items()
        if prompt.images[name].kind == "object" and objects
    }
    for name, record in shown.items():
        if len(record.object) + len(record.texture) > _MAX_NAMES:
            raise PromptError(f"image {echo(name)} has names of over {_MAX_NAMES} characters; shorten them.")
    text, nouns = _described(prompt.text, list(records), shown, prompts, rng)
    return RenderedPrompt(text, {name: image for name, image in prompt.images.items() if name not in nouns})


def image_descriptions(prompt: RenderedPrompt) -> dict[str, str]:
    """Return the description of the object in each object image by placeholder."""
    return {
        name: description_of(image.objects[0])
        for name, image in prompt.images.items()
        if image.kind == "object" and image.objects
    }


def description_of(record: ObjectRecord) -> str:
    """Return texture and name of an object, such as "red swirl letter A"."""
    return _description(record, record.object)


def synonyms(description: str) -> tuple[str, ...]:
    """Return the other descriptions of an object, by the aliases of its name.

    Example:
        >>> synonyms("red L-shaped block")
        ('red L-shape',)
    """
    specs = {**REGISTERED_OBJECTS, **OBJECTS}
    # The longest name that fits: "L-shaped block", not "block".
    noun = max((name for name in specs if f" {description}".endswith(f" {name}")), key=len, default="")
    return tuple(description.removesuffix(noun) + alias for alias in specs[noun].aliases) if noun else ()


def _described(
    text: str,
    names: Sequence[str],
    shown: Mapping[str, Placement] | Mapping[str, ObjectRecord],
    prompts: str,
    rng: np.random.Generator,
) -> tuple[str, dict[str, str]]:
    """Choose the images to replace, of those that show an object; return the text, and the noun of each."""
    form, _, synonyms = prompts.partition(",")
    nouns: dict[str, str] = {}
    for name, (image_draw, noun_draw) in zip(names, rng.random((len(names), 2)), strict=True):
        if name in shown and (form == "text" or (form == "mixed" and image_draw < _REPLACED_PROB)):
            known = _names(shown[name])
            nouns[name] = known[int(noun_draw * len(known))] if synonyms else known[0]
    phrases = {name: _description(shown[name], noun) for name, noun in nouns.items()}
    return with_phrases(text, phrases), nouns


def _names(item: Placement | ObjectRecord) -> tuple[str, ...]:
    spec = OBJECTS.get(item.object) or REGISTERED_OBJECTS.get(item.object)
    return (item.object, *(spec.aliases if spec else ()))


def _description(item: Placement | ObjectRecord, noun: str) -> str:
    return noun if item.texture == NEUTRAL_TEXTURE else f"{item.texture} {noun}"


def _is_ambiguous(image: Placement, noun: str, shown: Iterable[Placement], scene: Scene) -> bool:
    """Whether a description fits objects on the table or in the prompt that its image differs from."""
    gray = image.texture == NEUTRAL_TEXTURE

    def differs(other: Placement, size: bool) -> bool:
        if noun not in _names(other) or not (gray or other.texture == image.texture):
            return False
        if other.object != image.object:
            return True
        return not gray and (other.scale != image.scale or (size and other.size != image.size))

    on_table = any(placement.id == image.id for placement in scene.placements)
    rivals = scene.placements if on_table else ()
    return any(differs(other, True) for other in rivals) or any(differs(other, False) for other in shown)


def with_phrases(text: str, phrases: Mapping[str, str]) -> str:
    """Put phrases in place of placeholders, each with the article that its sentence needs.

    Example:
        >>> with_phrases("Put any {a} into the {b}.", {"a": "red cross", "b": "blue bowl"})
        'Put any red cross into the blue bowl.'
    """
    result = before = ""
    for number, piece in enumerate(PLACEHOLDER.split(text)):
        if number % 2 == 0:
            before = piece
        elif piece in phrases:
            # Only the text between: "the letter A the star" has an article that is none of the star's.
            result += _append_phrase(before, phrases[piece], is_first=not result and not before)
        else:
            result += f"{before}{{{piece}}}"
    return result + before


def _append_phrase(before: str, phrase: str, *, is_first: bool) -> str:
    """Append a phrase to the piece of text before it."""
    article = "an" if _VOWEL.match(phrase) else "a"
    if _INTRODUCED.search(before):
        return f"{before.rstrip()}: {article} {phrase}"
    if found := _ARTICLE.search(before):
        return f"{before[: found.start()]}{found[1]}{article[1:]} {phrase}"
    if _PLURAL.search(before):
        return f"{before}{phrase}{'es' if phrase.endswith(('s', 'x', 'sh', 'ch')) else 's'}"
    if _DETERMINED.search(before):
        return before + phrase
    starts_sentence = is_first or before.rstrip().endswith((".", "!", "?"))
    return f"{before}{'The' if starts_sentence else 'the'} {phrase}"


Phrasings = Mapping[str, tuple[str, ...]]


def training_paraphrases() -> Phrasings:
    """Return the paraphrases that training may use, by task."""
    return read_phrasings("openvima.tasks", "paraphrases.yaml")


@lru_cache
def read_phrasings(package: str, name: str) -> Phrasings:
    """Read a file of this package: task to templates, with the slots of the task's own template."""
    with resources.as_file(resources.files(package).joinpath(name)) as path:
        return {task: tuple(templates) for task, templates in read_yaml(path).items()}


def rephrase(text: str, template: str, phrasing: str) -> str | None:
    """Return the text of a prompt in another phrasing.

    Args:
        text: The text; images keep their placeholders, or descriptions are in place of them.
        template: The template that it follows, such as "Rotate the {dragged_obj} {angle} degrees."; a slot
            that occurs twice has one value.
        phrasing: Another template with the same slots.

    Returns:
        The text; None where it does not follow the template.

    Example:
        >>> rephrase("Rotate the {a} 30 degrees.", "Rotate the {x} {n} degrees.", "Turn the {x} by {n}.")
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
