"""Prompts under input ablations: other words, other images, or an example in place of the description.

Words: image slots and their order stay. A word is a run of letters, with hyphens inside, or a whole number.
Source of masked and swapped words: VIMA (Jiang et al. 2023), robustness against incomplete and corrupted
prompts; the rates are free here. Held-out phrasings: twenty of each of five tasks, never trained on.

In-context evaluation: prompts of three tasks, edited to contain an example, as inverse dynamics does.

| task | edited prompt |
|---|---|
| `twist` | "Follow this motion: {before} {after} for all red swirl objects." |
| `follow_motion` | "Follow this motion for {object}: {frames}.", its own prompt |
| `follow_order` | "Follow this motion: {frames}." |

All images are those of the task's own prompt, of `twist` the first pair. Policies are trained without these
tasks. Source: MIDAS (Li et al. 2023); which pair of `twist` it shows is not published.

Oracle demonstration: the oracle's observations in the very episode become the prompt "Follow this motion:
frame … frame". It contains the answer, so this measures whether a policy reproduces what it sees.
"""

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from openvima.env.tabletop import TabletopEnv
from openvima.errors import OracleError, PromptError, SamplingError, echo
from openvima.policies.tokenizer import UNKNOWN, benchmark_vocabulary
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Episode, ObjectRecord, Prompt, RenderedPrompt
from openvima.tasks import twist
from openvima.tasks.prompts import MULTIMODAL, Phrasings, read_phrasings, rephrase, rewrite
from openvima.tasks.registry import task_spec
from openvima.tasks.sampling import make_rng, sample_episode
from openvima.training.augmentation.prompts import MOTION_TEXT, motion_prompt

_SLOT_OR_WORD = re.compile(rf"\{{\w+\}}|{UNKNOWN}|[^\W\d_]+(?:-[^\W\d_]+)*|[0-9]+")
_SLOT_OR_PIECE = re.compile(r"\{\w+\}|[A-Za-z]+(?:-[A-Za-z]+)*|\d+|\S")
_COMPARED = re.compile(r"(?<=\bsame )(texture|profile)\b")
_LETTERS = "abcdefghijklmnopqrstuvwxyz"


def masked(text: str, rate: float, rng: np.random.Generator) -> str:
    """Replace each word by the unknown token with a probability.

    Example:
        >>> masked("Put the {a} into it.", 1, np.random.default_rng(0))
        '<unknown> <unknown> {a} <unknown> <unknown>.'
    """
    return _replace_words(text, lambda word: UNKNOWN if rng.random() < rate else word)


def swapped(text: str, rate: float, rng: np.random.Generator) -> str:
    """Swap neighbouring words, from left to right, each pair with a probability.

    Neighbours have nothing but space between them, so no word crosses an image or a mark. A word may be
    carried on by the next swap; on average that fraction of the neighbouring pairs is swapped.

    Example:
        >>> swapped("Put the {a} into it.", 1, np.random.default_rng(0))
        'the Put {a} it into.'
    """
    places = [found for found in _SLOT_OR_WORD.finditer(text) if found.group()[0] != "{"]
    words = [place.group() for place in places]
    for i in range(len(words) - 1):
        are_neighbours = not text[places[i].end() : places[i + 1].start()].strip()
        if are_neighbours and rng.random() < rate:
            words[i], words[i + 1] = words[i + 1], words[i]
    left = iter(words)
    return _replace_words(text, lambda _: next(left))


def gibberish(text: str, rng: np.random.Generator) -> str:
    """Replace the letters of each word by random ones, in each place of a word by the same."""

    @cache
    def drawn(word: str) -> str:
        letters = iter(rng.choice(list(_LETTERS), len(word)).tolist())
        return "".join(next(letters) if letter != "-" else "-" for letter in word)

    def replaced(word: str) -> str:
        if word.isdecimal() or word == UNKNOWN:
            return word
        new = drawn(word.lower())
        return new.capitalize() if word[0].isupper() else new

    return _replace_words(text, replaced)


def scrambled(text: str, rng: np.random.Generator) -> str:
    """Replace each word, number and mark by a random word of the benchmark."""
    pieces = _SLOT_OR_PIECE.findall(text)
    drawn = rng.choice(_benchmark_words(), len(pieces)).tolist()
    return " ".join(piece if piece[0] == "{" else word for piece, word in zip(pieces, drawn, strict=True))


def with_other_attribute(text: str) -> str:
    """Compare objects by the other attribute: by profile in place of texture, by texture in place of profile.

    Example:
        >>> with_other_attribute("Put all objects with the same texture as {a} into it.")
        'Put all objects with the same profile as {a} into it.'
    """
    return _COMPARED.sub(lambda found: "profile" if found[0] == "texture" else "texture", text)


def names_attribute(task: str) -> bool:
    """Whether the prompt of a task says by which attribute objects are compared."""
    return _COMPARED.search(task_spec(task).template) is not None


def _replace_words(text: str, change: Callable[[str], str]) -> str:
    """Replace the words of a text from left to right; image slots stay."""
    return _SLOT_OR_WORD.sub(lambda found: found[0] if found[0][0] == "{" else change(found[0]), text)


@cache
def _benchmark_words() -> tuple[str, ...]:
    return tuple(sorted(word for word in benchmark_vocabulary().words if word[0].isalpha()))


NEUTRAL_PROMPT = RenderedPrompt(".", {})  # not empty, as policies may refuse a prompt without any token
_MAX_TRIES = 100  # for tasks whose placeholders vary; those of the benchmark's own tasks never do
_LARGEST_SEED = 2**31  # of the episodes whose images are borrowed


def with_images_of_another(env: TabletopEnv, rng: np.random.Generator) -> RenderedPrompt:
    """Sample seeds until an episode has images of the same names and kinds, and describe the same of them.

    Raises:
        SamplingError: No other episode has images for the same placeholders.
    """
    episode = env.episode
    own = episode if env.prompts == MULTIMODAL else _multimodal(env, episode.seed)
    prompt = own.problem.prompt
    for _ in range(_MAX_TRIES):
        seed = int(rng.integers(_LARGEST_SEED))
        if seed == episode.seed:
            continue
        try:
            other = _multimodal(env, seed)
        except SamplingError:
            continue
        images = other.problem.prompt.images
        if _kinds(images) == _kinds(prompt.images):
            prompt_rng = make_rng(
                own.domain, own.task, own.level, own.seed, "prompt", attempt=own.num_redraws
            )
            swapped = rewrite(Prompt(prompt.text, images), other.problem.scene, env.prompts, prompt_rng)
            return Rasteriser(env.assets).prompt(swapped)
    raise SamplingError(
        f"{_MAX_TRIES} other episodes of {episode.task} at level {episode.level} have no images for "
        f"{prompt.text!r}; evaluate this task without the ablation other_prompt_images."
    )


def _multimodal(env: TabletopEnv, seed: int) -> Episode:
    """Sample an episode of an environment, with the published prompt."""
    return sample_episode(env.task, seed=seed, **settings_of(env))


def settings_of(env: TabletopEnv) -> dict[str, Any]:
    """Return what decides an environment's episodes, but for task, prompts and seed."""
    own = {"level": env.level, "domain": env.domain, "assets": env.assets, "compat": env.compat}
    return own | env.task_options


def _kinds(images: tuple[tuple[str, object], ...]) -> dict[str, type]:
    return {name: type(fill) for name, fill in images}


IN_CONTEXT_TASKS = ("twist", "follow_motion", "follow_order")
_MAX_SHOWN = 100  # characters of a prompt in an error
_TEXTURE = re.compile(re.escape(twist.REQUEST).replace(r"\{twist_obj_texture\}", "(.+)"))


def in_context_prompt(prompt: RenderedPrompt, task: str) -> RenderedPrompt:
    """Edit a prompt for in-context evaluation.

    Args:
        prompt: The task's own prompt.
        task: One of `IN_CONTEXT_TASKS`.

    Raises:
        PromptError: The prompt is not one of that task.
    """
    text, names = prompt.text, tuple(prompt.images)
    if task == "twist":
        found = _TEXTURE.search(text)
        if found is None or len(names) < 2:
            raise PromptError(f"{echo(repr(text), _MAX_SHOWN)} is no prompt of twist with a pair of images.")
        names = names[:2]
        text = f"Follow this motion: {_slots(names)} for all {found[1]} objects."
    elif task == "follow_order":
        text = MOTION_TEXT.format(frames=_slots(names))
    return RenderedPrompt(text, {name: prompt.images[name] for name in names})


def _slots(names: tuple[str, ...]) -> str:
    return " ".join(f"{{{name}}}" for name in names)


def demonstrated(env: TabletopEnv) -> RenderedPrompt:
    """Return the motion of the oracle in the episode that an environment has begun, as a prompt.

    If the oracle fails or has no action, the demonstration ends there.

    Args:
        env: The environment; it is left as it is.
    """
    own = TabletopEnv(env.task, hide_arm=env.hide_arm, **settings_of(env))
    seen = [own.reset(seed=env.episode.seed)[0]]
    while not own.outcome.is_over and len(seen) <= own.episode.oracle_max_steps:
        try:
            action = own.oracle_decision().action
        except OracleError:
            break
        seen.append(own.step(action)[0])
    objects = [ObjectRecord(p.id, p.object, p.texture) for p in own.scene.placements]
    return motion_prompt(seen, objects)


def held_out_phrasings() -> Phrasings:
    """Return the phrasings by task."""
    return read_phrasings("openvima.evaluation", "phrasings.yaml")


def in_held_out_phrasing(text: str, task: str, rng: np.random.Generator) -> str:
    """Return the text of a task's prompt in one of its held-out phrasings.

    Args:
        text: The text, with images or descriptions. Another form, such as a corrupted one, is unchanged.
        task: Name of the task.
        rng: Draws the phrasing.
    """
    phrasings = held_out_phrasings()[task]
    return rephrase(text, task_spec(task).template, phrasings[int(rng.integers(len(phrasings)))]) or text
