"""Input ablations: each removes or replaces one input of a policy on the same episodes.

| ablation | input of the policy |
|---|---|
| `no_prompt` | the same prompt in every episode: one full stop and no image |
| `other_prompt_images` | its own words, with the images, or their descriptions, of another episode |
| `scrambled_words` | its own images; each word, number and mark replaced by a random word of the benchmark |
| `shuffled_objects` | permuted object ids, in segmentations and in the records of the prompt |
| `detected_boxes` | boxes from a detector |
| `in_context` | its prompt, edited as for in-context evaluation (`in_context.py`) |
| `oracle_demonstration` | the oracle's solution of the same episode as the prompt |

Random choices follow from the episode's task, level and seed, not from the batch or the number of workers.
Starts, goals and step limits stay the same.

`shuffled_objects` keeps the order in which a prompt lists the objects of an image: a policy that ignores ids
and their order acts exactly as without the ablation.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from openvima.env.tabletop import TabletopEnv
from openvima.errors import SamplingError
from openvima.evaluation.in_context import in_context_prompt
from openvima.evaluation.oracle_demonstration import demonstrated
from openvima.policies.tokenizer import benchmark_vocabulary
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Episode, ObjectRecord, Prompt, PromptImage, RenderedPrompt
from openvima.tasks.prompts import MULTIMODAL, rewritten
from openvima.tasks.sampling import sample_episode
from openvima.tasks.seeding import make_rng

NO_PROMPT = "no_prompt"
OTHER_PROMPT_IMAGES = "other_prompt_images"
SCRAMBLED_WORDS = "scrambled_words"
SHUFFLED_OBJECTS = "shuffled_objects"
DETECTED_BOXES = "detected_boxes"
IN_CONTEXT = "in_context"
ORACLE_DEMONSTRATION = "oracle_demonstration"
ABLATIONS = (NO_PROMPT, OTHER_PROMPT_IMAGES, SCRAMBLED_WORDS, SHUFFLED_OBJECTS, DETECTED_BOXES)
EXAMPLE_PROMPTS = (IN_CONTEXT, ORACLE_DEMONSTRATION)
"""Replace the task's description by an example; not part of "all", as they add information."""

NEUTRAL_PROMPT = RenderedPrompt(".", {})  # not empty, as policies may refuse a prompt without any token
_MAX_TRIES = 100  # for tasks whose placeholders vary; those of the benchmark's own tasks never do
_LARGEST_SEED = 2**31  # of the episodes whose images are borrowed
_PIECE = re.compile(r"\{\w+\}|[A-Za-z]+(?:-[A-Za-z]+)*|\d+|\S")


@dataclass(frozen=True, slots=True, eq=False)
class AblatedInput:
    """Inputs of a policy in one episode.

    Args:
        prompt: The prompt.
        id_map: Maps each object id to that in observations, shape (256,), uint8; None is the identity.
    """

    prompt: RenderedPrompt
    id_map: np.ndarray | None = None

    def observation(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:  # Any: as the environment's
        """Return an observation with mapped ids."""
        if self.id_map is None or "segm" not in observation:
            return observation
        return {**observation, "segm": _renumbered(observation["segm"], self.id_map)}


def ablate(env: TabletopEnv, ablation: str) -> AblatedInput:
    """Return the inputs of a policy in the current episode of an environment.

    Args:
        env: The environment, which stays unchanged.
        ablation: One of `ABLATIONS` or `EXAMPLE_PROMPTS`, or empty for none. Detected boxes are handled by
            the policy, see `openvima.detector.plugins`.

    Raises:
        ConfigError: The task has no in-context evaluation.
        SamplingError: No other episode has images for the same placeholders.
    """
    if ablation == IN_CONTEXT:
        return AblatedInput(in_context_prompt(env.prompt, env.task))
    if ablation == ORACLE_DEMONSTRATION:
        return AblatedInput(demonstrated(env))
    if ablation == NO_PROMPT:
        return AblatedInput(NEUTRAL_PROMPT)
    if ablation in ("", DETECTED_BOXES):
        return AblatedInput(env.prompt)
    episode = env.episode
    rng = make_rng(episode.domain, episode.task, episode.level, episode.seed, f"control {ablation}")
    if ablation == OTHER_PROMPT_IMAGES:
        return AblatedInput(_with_images_of_another(env, rng))
    if ablation == SCRAMBLED_WORDS:
        return AblatedInput(replace(env.prompt, text=_scrambled(env.prompt.text, rng)))
    return _shuffled(env, rng)


def _with_images_of_another(env: TabletopEnv, rng: np.random.Generator) -> RenderedPrompt:
    """Sample seeds until an episode has images of the same names and kinds, and describe the same of them."""
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
            swapped = rewritten(Prompt(prompt.text, images), other.problem.scene, env.prompts, prompt_rng)
            return Rasteriser(env.assets).prompt(swapped)
    raise SamplingError(
        f"{_MAX_TRIES} other episodes of {episode.task} at level {episode.level} have no images for "
        f"{prompt.text!r}; evaluate this task without the ablation {OTHER_PROMPT_IMAGES}."
    )


def _multimodal(env: TabletopEnv, seed: int) -> Episode:
    """Sample an episode of an environment, with the published prompt."""
    return sample_episode(
        env.task,
        level=env.level,
        seed=seed,
        domain=env.domain,
        assets=env.assets,
        compat=env.compat,
        **env.task_options,
    )


def _kinds(images: tuple[tuple[str, object], ...]) -> dict[str, type]:
    return {name: type(fill) for name, fill in images}


def _scrambled(text: str, rng: np.random.Generator) -> str:
    """Replace each word, number and mark by a random word of the benchmark; placeholders stay."""
    pieces = _PIECE.findall(text)
    drawn = rng.choice(_words(), len(pieces)).tolist()
    return " ".join(piece if piece[0] == "{" else word for piece, word in zip(pieces, drawn, strict=True))


@cache
def _words() -> tuple[str, ...]:
    return tuple(sorted(word for word in benchmark_vocabulary().words if word[0].isalpha()))


def _shuffled(env: TabletopEnv, rng: np.random.Generator) -> AblatedInput:
    """Permute the ids of the objects on the table, and of those in the scenes of the prompt."""
    prompt = env.prompt
    id_map = _permutation({placement.id for placement in env.episode.problem.scene.placements}, rng)
    scenes = [image for image in prompt.images.values() if image.kind == "scene"]
    # One permutation for all images, as in the environment: an object keeps its id from frame to frame.
    prompt_id_map = _permutation({record.object_id for image in scenes for record in image.objects}, rng)
    images = {
        name: _relabelled(image, prompt_id_map) if image.kind == "scene" else image
        for name, image in prompt.images.items()
    }
    return AblatedInput(RenderedPrompt(prompt.text, images), id_map)


def _permutation(ids: set[int], rng: np.random.Generator) -> np.ndarray:
    table = np.arange(256, dtype=np.uint8)
    table[sorted(ids)] = rng.permutation(sorted(ids))
    return table


def _relabelled(image: PromptImage, id_map: np.ndarray) -> PromptImage:
    records = tuple(
        ObjectRecord(int(id_map[record.object_id]), record.object, record.texture) for record in image.objects
    )
    return replace(image, segm=_renumbered(image.segm, id_map), objects=records)


def _renumbered(segm: Mapping[str, np.ndarray], id_map: np.ndarray) -> dict[str, np.ndarray]:
    return {view: id_map[ids] for view, ids in segm.items()}
