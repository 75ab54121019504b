"""The texts of a run, of which the vocabulary of its network is built."""

from collections.abc import Iterator

import pyarrow.compute as pc

from openvima.data.reader import Dataset
from openvima.perception.preprocessing import split_prompt
from openvima.tasks.novel_words import NOUNS
from openvima.training.augmentation.inverse_dynamics import motion_text
from openvima.training.augmentation.prompt_images import DEFINITION
from openvima.training.config import AugmentationConfig


def training_texts(dataset: Dataset, augmentation: AugmentationConfig) -> Iterator[str]:
    """Read the different texts between the placeholders of the prompts, and those of the augmentation.

    Args:
        dataset: The demonstrations; of these only the prompts are read.
        augmentation: Settings; an inverse-dynamics prompt and novel nouns bring words of their own.

    Raises:
        ShardError: A shard is damaged.
    """
    prompts: set[str] = set()
    for name in dataset.shard_names():  # 0.1 ms per demonstration
        table = dataset.shard(name).table(["task", "prompt"])
        if dataset.tasks is not None:  # a shard may hold others
            table = table.filter(pc.field("task").isin(dataset.tasks))
        prompts.update(table.column("prompt").unique().to_pylist())
    if augmentation.inverse_dynamics_prob:
        prompts.add(motion_text(1))
    if augmentation.rename_objects_prob:
        prompts.update(DEFINITION.format(noun=f"the {noun}", image="") for noun in NOUNS)
    for prompt in prompts:
        yield from (piece for piece in split_prompt(prompt) if isinstance(piece, str))
