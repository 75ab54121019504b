"""Checks before training that all demonstrations fit into the context of a network."""

import numpy as np
import torch

from openvima.data.object_cache import ObjectCache
from openvima.data.preprocessed import PreprocessedEpisode
from openvima.errors import DatasetError, PolicyError
from openvima.perception.preprocessing import split_prompt
from openvima.policies.nn.actions import ACTION_WIDTH
from openvima.policies.nn.decoder import MAX_POSITIONS, MAX_PROMPT_POSITIONS
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.processor import Processor
from openvima.render.camera import VIEWS
from openvima.training.augmentation.prompts import motion_text, with_descriptions, with_motion_prompt

MAX_READ = 256  # of those that may be too long the longest are checked


def check_lengths(
    cache: ObjectCache,
    network: PolicyNetwork,
    processor: Processor,
    *,
    inverse_dynamics_prob: float = 0.0,
    describes: bool = False,
) -> None:
    """Run the network on the longest demonstrations, if they may be too long.

    Args:
        cache: All demonstrations.
        network: The network; it is left in evaluation mode.
        processor: Its processor.
        inverse_dynamics_prob: Probability of inverse dynamics.
        describes: Whether descriptions take the place of object images.

    Raises:
        DatasetError: A demonstration has more tokens than the network takes.
    """
    if not len(cache):
        return
    network.eval()
    for is_motion in [
        *([False] if inverse_dynamics_prob < 1 else []),
        *([True] if inverse_dynamics_prob else []),
    ]:
        prompt, whole = _upper_bounds(cache, processor, is_motion, describes)
        excess = np.maximum(prompt / MAX_PROMPT_POSITIONS, whole / MAX_POSITIONS)
        longest = np.argsort(-excess, kind="stable")[:MAX_READ]
        for row in longest[excess[longest] > 1]:
            episode = cache[int(row)]
            _forward(network, processor, with_motion_prompt(episode) if is_motion else episode, is_motion)
            if describes and not is_motion:  # longer than any image
                _forward(network, processor, with_descriptions(episode, 1.0, np.random.default_rng()), False)


def _upper_bounds(
    cache: ObjectCache, processor: Processor, is_motion: bool, describes: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds on the positions of each prompt, and of prompt and history together, shape (N,)."""
    steps, (in_prompt, in_view) = cache.lengths()[:, 0], cache.widths().T
    texts = [motion_text(1)] if is_motion else cache.texts()
    pieces = [split_prompt(text) for text in texts]
    words = max(
        sum(len(processor.tokenizer.encode(p)) for p in text if isinstance(p, str)) for text in pieces
    )
    if is_motion:
        images = (steps + 1) * _tokens_of(in_view, processor)
    else:
        described = cache.descriptions() if describes else ()
        # A description comes with an article, a colon or an ending.
        longest = max((len(processor.tokenizer.encode(text)) + 3 for text in described), default=0)
        per_image = np.maximum(_tokens_of(in_prompt, processor), longest)
        images = max(sum(isinstance(p, int) for p in text) for text in pieces) * per_image
    prompt = words + images + 1  # end of prompt
    return prompt, prompt + 1 + steps * (_tokens_of(in_view + len(VIEWS), processor) + 1 + ACTION_WIDTH)


def _tokens_of(num_objects: np.ndarray, processor: Processor) -> np.ndarray:
    """Return the tokens of an image with so many objects."""
    if processor.tokens_per_image:
        return np.full_like(num_objects, processor.tokens_per_image)
    return num_objects * (len(VIEWS) if processor.layout == "views" else 1)


@torch.no_grad()
def _forward(
    network: PolicyNetwork, processor: Processor, episode: PreprocessedEpisode, is_motion: bool
) -> None:
    """Run the network on one demonstration, with black images."""
    device = next(network.parameters()).device
    batch = processor.collate([episode]).to(device)
    height, width = processor.image_size
    black = network.encode_images(torch.zeros(1, 3, height, width, dtype=torch.uint8, device=device))
    features = black.expand(1 + len(episode.images), *black.shape[1:])
    try:
        prompt = network.encode_prompt(batch.prompts, features)
        network.loss(prompt, batch.history, features, batch.targets)
    except PolicyError as error:
        prompt_kind = " with its inverse-dynamics prompt" if is_motion else ""
        raise DatasetError(
            f"episode {episode.seed} of {episode.task}{prompt_kind} is too long to train on: {error} Or "
            "leave its task out, with `openvima data sample --tasks`."
        ) from None
