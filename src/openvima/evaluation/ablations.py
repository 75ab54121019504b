"""Input ablations: each removes, replaces or corrupts one input of a policy, or makes the episodes harder.

An ablation is named NAME or NAME:RATE. Names joined by "+", such as `masked_words:0.2+noisy_boxes:3`, are one
ablation of all of them. `INPUT_ABLATIONS` lists them; those that change the prompt are functions of
`prompt_ablations.py`. Under other task options a seed stands for another scene, so these episodes are not
paired with the plain ones.

Random choices follow from the episode's task, level and seed and the ablation's name, not from the batch or
the number of workers. They are the same at every rate: what a low rate masks or swaps, a high one does too.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from openvima.env.config import EnvConfig
from openvima.env.tabletop import TabletopEnv
from openvima.errors import ConfigError, echo, unknown_name
from openvima.evaluation.prompt_ablations import (
    IN_CONTEXT_TASKS,
    NEUTRAL_PROMPT,
    demonstrated,
    gibberish,
    held_out_phrasings,
    in_context_prompt,
    in_held_out_phrasing,
    masked,
    names_attribute,
    scrambled,
    swapped,
    with_images_of_another,
    with_other_attribute,
)
from openvima.evaluation.sources import ORACLE, RANDOM
from openvima.perception.boxes import BoxJitter
from openvima.scene import PromptImage, RenderedPrompt
from openvima.tasks.options import MAX_DISTRACTORS, options_text, parse_options
from openvima.tasks.sampling import check_task_options, make_rng, takes_prompts


@dataclass(frozen=True, slots=True, eq=False)
class AblatedInput:
    """Inputs of a policy in one episode.

    Args:
        prompt: The prompt.
        id_map: Maps each object id to that in observations, shape (256,), uint8; None is the identity.
        jitter: Moves the boxes of observations; None leaves them.
    """

    prompt: RenderedPrompt
    id_map: np.ndarray | None = None
    jitter: BoxJitter | None = None

    def observation(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the next observation of the episode, with mapped ids and moved boxes."""
        if self.id_map is not None and "segm" in observation:
            observation = {**observation, "segm": renumbered(observation["segm"], self.id_map)}
        return observation if self.jitter is None else self.jitter.observation(observation)


def renumbered(segm: Mapping[str, np.ndarray], id_map: np.ndarray) -> dict[str, np.ndarray]:
    """Map the ids of a segmentation, view by view."""
    return {view: id_map[ids] for view, ids in segm.items()}


_NUM_DISTRACTORS = "num_distractors"


def with_text_prompts(env_config: EnvConfig, _: float) -> EnvConfig:
    """Describe all objects in prompts; synonyms stay if they are asked for."""
    _form, comma, synonyms = env_config.prompts.partition(",")
    return replace(env_config, prompts=f"text{comma}{synonyms}")


def with_paraphrased_prompts(env_config: EnvConfig, _: float) -> EnvConfig:
    """Describe objects by synonyms: all of them, or some where prompts are mixed."""
    form = "mixed" if env_config.prompts.startswith("mixed") else "text"
    return replace(env_config, prompts=f"{form},paraphrased")


def has_form(task: str, env_config: EnvConfig) -> bool:
    """Whether a task takes the prompts of an environment, with an object image to describe."""
    return takes_prompts(task, "text") and takes_prompts(task, env_config.prompts)


def with_num_distractors(env_config: EnvConfig, count: float) -> EnvConfig:
    """Put so many distractors on the table, in place of the number that the settings name."""
    options = parse_options(env_config.task_options)
    others = {key: value for key, value in options.items() if key[1] != _NUM_DISTRACTORS}
    options = {**others, ("", _NUM_DISTRACTORS): str(int(count))}
    return replace(env_config, task_options=options_text(options))


def allows_num_distractors(task: str, env_config: EnvConfig) -> bool:
    """Whether a task has the option and takes as many."""
    count = parse_options(env_config.task_options)["", _NUM_DISTRACTORS]
    try:
        check_task_options((task,), f"{_NUM_DISTRACTORS}={count}")
    except ConfigError:
        return False
    return True


def shuffled(env: TabletopEnv, seen: AblatedInput, rng: np.random.Generator) -> AblatedInput:
    """Permute the ids of the objects on the table, and of those in the scenes of the prompt.

    The order in which a prompt lists the objects of an image stays: a policy that ignores ids and their order
    acts exactly as before.
    """
    id_map = _permutation({placement.id for placement in env.episode.problem.scene.placements}, rng)
    scenes = [image for image in seen.prompt.images.values() if image.kind == "scene"]
    # One permutation for all images, as in the environment: an object keeps its id from frame to frame.
    prompt_id_map = _permutation({record.object_id for image in scenes for record in image.objects}, rng)

    def relabelled(image: PromptImage) -> PromptImage:
        if image.kind != "scene":
            return image
        records = tuple(
            replace(record, object_id=int(prompt_id_map[record.object_id])) for record in image.objects
        )
        return replace(image, segm=renumbered(image.segm, prompt_id_map), objects=records)

    return replace(_with_images(seen, relabelled), id_map=id_map)


def with_shuffled_prompt_objects(seen: AblatedInput, rng: np.random.Generator) -> AblatedInput:
    """Let each prompt image list its objects in an order of its own; an object keeps its id."""

    def shuffled(image: PromptImage) -> PromptImage:
        order = rng.permutation(len(image.objects))
        return replace(image, objects=tuple(image.objects[k] for k in order))

    return _with_images(seen, shuffled)


def jittered(seen: AblatedInput, pixels: int, rng: np.random.Generator) -> AblatedInput:
    """Move the borders of all boxes, in prompt images and observations."""
    jitter = BoxJitter(pixels, rng)
    return replace(_with_images(seen, jitter.prompt_image), jitter=jitter)


def _with_images(seen: AblatedInput, change: Callable[[PromptImage], PromptImage]) -> AblatedInput:
    images = {name: change(image) for name, image in seen.prompt.images.items()}
    return replace(seen, prompt=replace(seen.prompt, images=images))


def _permutation(ids: set[int], rng: np.random.Generator) -> np.ndarray:
    table = np.arange(256, dtype=np.uint8)
    table[sorted(ids)] = rng.permutation(sorted(ids))
    return table


DETECTED_BOXES = "detected_boxes"
NOISY_BOXES = "noisy_boxes"
IN_CONTEXT = "in_context"
ORACLE_DEMONSTRATION = "oracle_demonstration"

Change = Callable[[TabletopEnv, AblatedInput, float, np.random.Generator], AblatedInput]


class Rate(NamedTuple):
    """The number in an ablation's name.

    Args:
        least: Smallest rate.
        most: Largest rate.
        example: A rate, for errors; an integer where rates are whole numbers.
    """

    least: float
    most: float
    example: float


@dataclass(frozen=True, slots=True, eq=False)
class InputAblation:
    """An input ablation. It changes the input, the environment, or (detected boxes) the policy's extractor.

    Args:
        name: Its name, without the rate.
        description: What the policy gets, in one sentence.
        change: Changes the inputs of an episode.
        environment: Changes the settings of the environment.
        takes: Whether it applies to a task, given the changed settings.
        rates: The rates that it takes; None for none.
        rate: Its rate; 0 without one.
        exclusive: What only one ablation of several can set: "prompts" (their form), "words" or "boxes".
        changes_scenes: Whether a seed stands for another scene.
    """

    name: str
    description: str
    change: Change = lambda env, seen, rate, rng: seen
    environment: Callable[[EnvConfig, float], EnvConfig] = lambda env_config, rate: env_config
    takes: Callable[[str, EnvConfig], bool] = lambda task, env_config: True
    rates: Rate | None = None
    rate: float = 0
    exclusive: str = ""
    changes_scenes: bool = False

    def __str__(self) -> str:
        rate = np.format_float_positional(self.rate, trim="-")
        return f"{self.name}:{rate}" if self.rates else self.name

    @property
    def form(self) -> str:
        """How it is written, with an example of a rate."""
        return str(replace(self, rate=self.rates.example)) if self.rates else self.name


def _in_words(rewrite: Callable[[str, float, np.random.Generator], str]) -> Change:
    """Lift a change of text to a change of inputs."""

    def change(env: TabletopEnv, seen: AblatedInput, rate: float, rng: np.random.Generator) -> AblatedInput:
        return _with_text(seen, rewrite(seen.prompt.text, rate, rng))

    return change


def _with_text(seen: AblatedInput, text: str) -> AblatedInput:
    return replace(seen, prompt=replace(seen.prompt, text=text))


_PROBABILITY = Rate(0, 1, 0.2)

# Those that one name joins are applied in this order.
INPUT_ABLATIONS = {
    ablation.name: ablation
    for ablation in (
        InputAblation(
            "text_prompts",
            "Each object image of the prompt is replaced by a description.",
            environment=with_text_prompts,
            takes=has_form,
            exclusive="prompts",
        ),
        InputAblation(
            "paraphrased_prompts",
            "Each object image of the prompt is replaced by a description with synonyms.",
            environment=with_paraphrased_prompts,
            takes=has_form,
            exclusive="prompts",
        ),
        InputAblation(
            "num_distractors",
            "So many distractors lie on the table, in scenes of their own.",
            environment=with_num_distractors,
            takes=allows_num_distractors,
            rates=Rate(0, MAX_DISTRACTORS, 6),
            changes_scenes=True,
        ),
        InputAblation(
            "other_prompt_images",
            "The prompt keeps its words; its images come from another episode of the task.",
            lambda env, seen, rate, rng: AblatedInput(with_images_of_another(env, rng)),
        ),
        InputAblation(
            "no_prompt",
            "The prompt is a full stop in every episode; only the table is left.",
            lambda env, seen, rate, rng: AblatedInput(NEUTRAL_PROMPT),
            exclusive="prompts",
        ),
        InputAblation(
            ORACLE_DEMONSTRATION,
            "The prompt is the oracle's solution of the same episode.",
            lambda env, seen, rate, rng: AblatedInput(demonstrated(env)),
            exclusive="prompts",
        ),
        InputAblation(
            IN_CONTEXT,
            "The prompt is edited to contain an example from the task's own prompt, as in MIDAS.",
            lambda env, seen, rate, rng: AblatedInput(in_context_prompt(seen.prompt, env.task)),
            takes=lambda task, env_config: task in IN_CONTEXT_TASKS,
            exclusive="prompts",
        ),
        InputAblation(
            "held_out_phrasings",
            "The prompt is in other words, in one of twenty phrasings that no training used.",
            lambda env, seen, rate, rng: _with_text(
                seen, in_held_out_phrasing(seen.prompt.text, env.episode.task, rng)
            ),
            takes=lambda task, env_config: task in held_out_phrasings(),
            exclusive="words",
        ),
        InputAblation(
            "swapped_attribute",
            'The prompt asks for the same profile in place of "the same texture", and the other way round.',
            _in_words(lambda text, rate, rng: with_other_attribute(text)),
            takes=lambda task, env_config: names_attribute(task),
            exclusive="words",
        ),
        InputAblation(
            "scrambled_words",
            "The prompt keeps its images; each word is replaced by a random word.",
            _in_words(lambda text, rate, rng: scrambled(text, rng)),
        ),
        InputAblation(
            "gibberish_words",
            "The prompt keeps its images; each word is replaced by random letters.",
            _in_words(lambda text, rate, rng: gibberish(text, rng)),
        ),
        InputAblation(
            "swapped_words",
            "The prompt keeps its images; neighbouring words are swapped, each pair with this probability.",
            _in_words(swapped),
            rates=_PROBABILITY,
        ),
        InputAblation(
            "masked_words",
            "The prompt keeps its images; each word is the unknown token with this probability.",
            _in_words(masked),
            rates=_PROBABILITY,
        ),
        InputAblation(
            "shuffled_objects",
            "Object ids are permuted; only with compat do they reveal the order of spawning.",
            lambda env, seen, rate, rng: shuffled(env, seen, rng),
        ),
        InputAblation(
            "shuffled_prompt_objects",
            "Each prompt image lists its objects in an order of its own.",
            lambda env, seen, rate, rng: with_shuffled_prompt_objects(seen, rng),
        ),
        InputAblation(
            DETECTED_BOXES,
            "Boxes come from a detector instead of the simulator.",
            exclusive="boxes",
        ),
        InputAblation(
            NOISY_BOXES,
            "The borders of all boxes are moved by up to so many pixels.",
            lambda env, seen, rate, rng: jittered(seen, int(rate), rng),
            rates=Rate(1, 32, 3),
            exclusive="boxes",
        ),
    )
}
ABLATIONS = ("no_prompt", "other_prompt_images", "scrambled_words", "shuffled_objects", DETECTED_BOXES)
"""What "all" stands for; detected boxes only where a detector is given."""
MORE_ABLATIONS = ("all", RANDOM, ORACLE)
"""Names that evaluations take beside those of ablations."""


def ablate(env: TabletopEnv, ablation: str) -> AblatedInput:
    """Return the inputs of a policy in the current episode of an environment.

    Args:
        env: The environment, which stays unchanged; its settings are those of `ablated_environment`.
        ablation: As for `ablation_parts`. Detected boxes are handled by the policy, see
            `openvima.detector.plugins`.

    Raises:
        ConfigError: As for `ablation_parts`, or the task has no in-context evaluation.
        SamplingError: No other episode has images for the same placeholders.
    """
    seen, episode = AblatedInput(env.prompt), env.episode
    for part in ablation_parts(ablation):
        purpose = f"control {part.name}"
        rng = make_rng(episode.domain, episode.task, episode.level, episode.seed, purpose)
        seen = part.change(env, seen, part.rate, rng)
    return seen


def ablated_environment(ablation: str, env_config: EnvConfig) -> EnvConfig:
    """Return the settings of the environment under an ablation; most leave them as they are.

    Raises:
        ConfigError: As for `ablation_parts`.
    """
    for part in ablation_parts(ablation):
        env_config = part.environment(env_config, part.rate)
    return env_config


def applies_to(ablation: str, task: str, env_config: EnvConfig) -> bool:
    """Whether an ablation applies to a task.

    Args:
        ablation: As for `ablation_parts`.
        task: Name of the task.
        env_config: Settings under the ablation, from `ablated_environment`.
    """
    return all(part.takes(task, env_config) for part in ablation_parts(ablation))


def scenes_of(ablation: str) -> str:
    """Return the parts that make a seed stand for another scene; empty where scenes are the plain ones.

    Args:
        ablation: As results name it; other names than those of ablations change no scenes.
    """
    parts = zip(ablation.split("+"), map(INPUT_ABLATIONS.get, names_in(ablation)), strict=True)
    return "+".join(part for part, found in parts if found is not None and found.changes_scenes)


def names_in(text: str) -> list[str]:
    """Return the parts of an ablation's name without their rates; they need not be known."""
    return [part.partition(":")[0].strip() for part in text.split("+")]


@lru_cache
def ablation_parts(text: str) -> tuple[InputAblation, ...]:
    """Read NAME, NAME:RATE, or several of them joined by "+".

    Returns:
        The ablations in the order of `INPUT_ABLATIONS`, in which they are applied; none for an empty text.

    Raises:
        ConfigError: There is no such ablation, a rate is missing, not allowed or out of range, or two
            ablations exclude each other.
    """
    parts = [_parse_rated(word.strip()) for word in text.split("+")] if text else []
    parts.sort(key=lambda part: [*INPUT_ABLATIONS].index(part.name))
    for one, other in combinations(parts, 2):
        if one.name == other.name or (one.exclusive and one.exclusive == other.exclusive):
            raise ConfigError(
                f"ablation {echo(repr(text))}: {one} and {other} exclude each other; give one of them."
            )
    return tuple(parts)


def _parse_rated(text: str) -> InputAblation:
    name, colon, number = text.partition(":")
    ablation = INPUT_ABLATIONS.get(name)
    if ablation is None:
        known = ", ".join(each.form for each in INPUT_ABLATIONS.values())
        allowed = f"Allowed: {known}; and alone {', '.join(MORE_ABLATIONS)}."
        raise ConfigError(unknown_name("ablation", name, INPUT_ABLATIONS, allowed))
    rates, kind = ablation.rates, ""
    if rates is not None:
        with suppress(ValueError):
            if rates.least <= (rate := type(rates.example)(number)) <= rates.most:
                return replace(ablation, rate=rate)
        kind = "an integer" if isinstance(rates.example, int) else "a number"
        kind = f", with {kind} from {rates.least} to {rates.most}"
    elif not colon:
        return ablation
    raise ConfigError(f"ablation {echo(repr(text))}: write {ablation.form}{kind}.")
