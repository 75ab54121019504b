"""The demonstrations of a run before its first step: opened, checked, and split for validation."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from openvima.data.object_cache import ObjectCache
from openvima.data.preprocessed import PreprocessedEpisode
from openvima.data.reader import Dataset, data_folder, read_manifest, split_hashes
from openvima.data.rerender import UNKNOWN_SCENES
from openvima.errors import ConfigError, DatasetError, PolicyError, unknown_name
from openvima.perception.preprocessing import split_prompt
from openvima.policies.nn.actions import ACTION_WIDTH
from openvima.policies.nn.decoder import MAX_POSITIONS, MAX_PROMPT_POSITIONS
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.processor import Processor
from openvima.render.camera import VIEWS
from openvima.tasks.registry import list_tasks
from openvima.training.augmentation.prompts import motion_text, text_of, with_descriptions, with_motion_prompt
from openvima.training.batches import BatchOrder, ExampleSource
from openvima.training.run_folder import held_out_demonstrations

MAX_READ = 256  # of those that may be too long the longest are checked
_PRIOR_DEMONSTRATIONS = 10_000  # enough for the marginals of 100 bins


def open_demonstrations(
    folder: Path, excluded: Sequence[str] = (), *, allow_heldout: bool = False
) -> Dataset:
    """Open a folder of demonstrations without those of some tasks, for training.

    Args:
        folder: The folder.
        excluded: Names of tasks; the folder need not have any of them.
        allow_heldout: Accept demonstrations that are held out for evaluation.

    Raises:
        ConfigError: There is no such task, or no other one is left.
        DatasetError: The folder is no finished data set, or holds demonstrations that are held out.
    """
    dataset = _leave_out_tasks(folder, excluded)
    if (found := held_out_demonstrations(dataset)) and not allow_heldout:
        raise DatasetError(
            f"{folder} holds demonstrations for evaluation only: {', '.join(found)}. Train on level train, "
            "leave these tasks out, or give --allow-heldout, which is recorded with the policy."
        )
    return dataset


def _leave_out_tasks(folder: Path, excluded: Sequence[str]) -> Dataset:
    if not excluded:
        return Dataset(folder)
    folder = data_folder(folder)
    present = sorted(read_manifest(folder)["tasks"])
    known = {*present, *list_tasks()}
    if problems := [
        unknown_name("task", name, known, f"{folder} has {', '.join(present)}.")
        for name in excluded
        if name not in known
    ]:
        raise ConfigError(f"loader.exclude_tasks: {' '.join(problems)}")
    kept = [task for task in present if task not in excluded]
    if not kept:
        raise ConfigError(
            f"loader.exclude_tasks is {', '.join(excluded)}; {folder} has no other task, only "
            f"{', '.join(present)}."
        )
    return Dataset(folder, tasks=kept)


def check_scenes(dataset: Dataset) -> None:
    """Check that the scenes of demonstrations are known, by the first one of each shard.

    Raises:
        DatasetError: They are not, as in imported data.
    """
    for name in dataset.shard_names():
        if not len(dataset.shard(name).read(0, ["poses"])["poses"]):
            raise DatasetError(UNKNOWN_SCENES.format(f"shard {name}"))


def split_examples(
    cache: ObjectCache, *, validation_fraction: float, validation_episodes: int
) -> tuple[ExampleSource, ExampleSource]:
    """Split demonstrations into training and validation.

    The split follows from task and seed, so that it stays the same when data are added.

    Args:
        cache: All demonstrations.
        validation_fraction: Fraction to hold out.
        validation_episodes: Maximum number of them.

    Raises:
        DatasetError: There is none to train on.
    """
    hashes = split_hashes(cache.dataset.index)
    counts = cache.image_counts()
    bases = np.cumsum(counts) - counts
    lengths = cache.lengths()
    training, kept = (
        np.flatnonzero(hashes >= validation_fraction),
        np.flatnonzero(hashes < validation_fraction),
    )
    if not len(training):
        raise DatasetError(
            "there is no demonstration to train on; generate some, or lower loader.validation_fraction."
        )
    kept = np.sort(kept[np.argsort(hashes[kept], kind="stable")[:validation_episodes]])
    first, second = (ExampleSource(cache, rows, bases, lengths[rows]) for rows in (training, kept))
    return first, second


def repeat_tasks(source: ExampleSource, repeats: Mapping[str, int]) -> ExampleSource:
    """Let an epoch show the demonstrations of some tasks several times.

    Raises:
        ConfigError: There is no such task.
    """
    tasks = source.cache.dataset.index.column("task").to_numpy(zero_copy_only=False)[source.rows]
    known = {*tasks, *list_tasks()}
    for name in repeats.keys() - known:
        raise ConfigError(f"loader.repeat_tasks: {unknown_name('task', name, known)}")
    counts = [repeats.get(task, 1) for task in tasks]
    rows, lengths = np.repeat(source.rows, counts), np.repeat(source.lengths, counts, axis=0)
    return replace(source, rows=rows, lengths=lengths)


def alternative_source(cache: ObjectCache, source: ExampleSource, first_image: int) -> ExampleSource:
    """Return the demonstrations of a source as another cache has them.

    Args:
        cache: Of detected boxes, or of random appearance; it may lack some of them.
        source: The demonstrations.
        first_image: Number of its first image: its images follow those of other caches.
    """
    counts = cache.image_counts()
    bases = np.cumsum(counts) - counts + first_image
    lengths = cache.lengths()
    rows = source.rows[lengths[source.rows, 0] > 0]
    return ExampleSource(cache, rows, bases, lengths[rows])


def read_actions(source: ExampleSource) -> torch.Tensor:
    """Return the actions of evenly spaced demonstrations, (N, 12), for the prior of an action head."""
    stride = max(1, len(source) // _PRIOR_DEMONSTRATIONS)
    rows = range(0, len(source), stride)
    return torch.from_numpy(np.concatenate([source[row].episode.actions for row in rows]))


def check_words(cache: ObjectCache, processor: Processor, *, describes: bool = False) -> None:
    """Check before training that T5 has the words of every prompt; other vocabularies are built of them.

    Args:
        cache: All demonstrations.
        processor: It has the tokenizer.
        describes: Whether descriptions take the place of object images.

    Raises:
        PromptError: A prompt has a word that T5 lacks.
    """
    for text in (*cache.texts(), *(map(text_of, cache.descriptions()) if describes else ())):
        for piece in split_prompt(text):
            if isinstance(piece, str):
                processor.tokenizer.encode(piece)


def make_order(
    source: ExampleSource, *, batch_size: int, seed: int, bucket: int, rank: int, num_ranks: int
) -> BatchOrder:
    """Return the order of demonstrations; a batch is at most as large as the data.

    Raises:
        ConfigError: The processes cannot share the demonstrations, or a batch of them, equally.
    """
    if len(source) < num_ranks:
        raise ConfigError(
            f"there are {len(source)} demonstrations to train on and {num_ranks} processes; start fewer of "
            "these, or generate more."
        )
    batch_size = min(batch_size, len(source) // num_ranks * num_ranks)
    return BatchOrder(
        len(source),
        batch_size=batch_size,
        seed=seed,
        lengths=source.lengths if bucket else None,
        bucket=max(1, bucket),
        rank=rank,
        num_ranks=num_ranks,
    )


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
        images = (steps + 1) * _count_tokens(in_view, processor)
    else:
        described = cache.descriptions() if describes else ()
        # A description comes with an article, a colon or an ending.
        longest = max((len(processor.tokenizer.encode(text)) + 3 for text in described), default=0)
        per_image = np.maximum(_count_tokens(in_prompt, processor), longest)
        images = max(sum(isinstance(p, int) for p in text) for text in pieces) * per_image
    prompt = words + images + 1  # end of prompt
    return prompt, prompt + 1 + steps * (_count_tokens(in_view + len(VIEWS), processor) + 1 + ACTION_WIDTH)


def _count_tokens(num_objects: np.ndarray, processor: Processor) -> np.ndarray:
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
