"""Ablations of the images of a prompt."""

import numpy as np

from openvima.env.tabletop import TabletopEnv
from openvima.errors import SamplingError
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Episode, Prompt, RenderedPrompt
from openvima.tasks.prompts import MULTIMODAL, rewritten
from openvima.tasks.sampling import make_rng, sample_episode

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
            swapped = rewritten(Prompt(prompt.text, images), other.problem.scene, env.prompts, prompt_rng)
            return Rasteriser(env.assets).prompt(swapped)
    raise SamplingError(
        f"{_MAX_TRIES} other episodes of {episode.task} at level {episode.level} have no images for "
        f"{prompt.text!r}; evaluate this task without the ablation other_prompt_images."
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
