"""The texts of a run, of which the vocabulary of its network is built."""

from collections.abc import Iterator

import pyarrow as pa
import pyarrow.compute as pc

from openvima.data.reader import Dataset
from openvima.perception.preprocessing import split_prompt
from openvima.scene import ObjectRecord
from openvima.tasks.novel_words import NOUNS
from openvima.tasks.paraphrasing import training_paraphrases
from openvima.tasks.prompts import description_of, synonyms
from openvima.training.augmentation.describe_objects import text_of
from openvima.training.augmentation.inverse_dynamics import motion_text
from openvima.training.augmentation.prompt_images import DEFINITION
from openvima.training.config import AugmentationConfig
from openvima.training.pretraining.captions import caption_texts


def training_texts(
    dataset: Dataset, augmentation: AugmentationConfig, *, with_captions: bool = False
) -> Iterator[str]:
    """Read the different texts between the placeholders of the prompts, and those of the augmentation.

    Args:
        dataset: The demonstrations; of these only the prompts are read.
        augmentation: Settings; an inverse-dynamics prompt and novel nouns bring words of their own.
        with_captions: Also yield the words of captions of attributes.

    Raises:
        ShardError: A shard is damaged.
    """
    prompts: set[str] = set()
    for table in _tables(dataset, "prompt"):  # 0.1 ms per demonstration
        prompts.update(table.column("prompt").unique().to_pylist())
    if augmentation.inverse_dynamics_prob:
        prompts.add(motion_text(1))
    if augmentation.describes_objects:
        descriptions = _descriptions(dataset)
        prompts.update(map(text_of, descriptions))
        if augmentation.synonym_prob:
            prompts.update(text_of(other) for each in descriptions for other in synonyms(each))
    if augmentation.paraphrase_prob:
        tasks = set(dataset.index.column("task").to_pylist())
        prompts.update(text for task in tasks for text in training_paraphrases().get(task, ()))
    if augmentation.rename_objects_prob:
        prompts.update(DEFINITION.format(noun=f"the {noun}", image="") for noun in NOUNS)
    if with_captions:
        yield from caption_texts()
    for prompt in prompts:
        yield from (piece for piece in split_prompt(prompt) if isinstance(piece, str))


def _tables(dataset: Dataset, column: str) -> Iterator[pa.Table]:
    """Read a column of all demonstrations, shard by shard."""
    for name in dataset.shard_names():
        table = dataset.shard(name).table(["task", column])
        # A shard may also hold tasks that the data set leaves out.
        yield table if dataset.tasks is None else table.filter(pc.field("task").isin(dataset.tasks))


def _descriptions(dataset: Dataset) -> set[str]:
    """Return the different descriptions of objects in object images."""
    names = set()
    for table in _tables(dataset, "prompt_images"):
        images = pa.Table.from_struct_array(table.column("prompt_images").combine_chunks().flatten())
        shown = images.filter(pc.field("kind") == "object").column("objects").combine_chunks().flatten()
        records = pa.Table.from_struct_array(shown).select(["object", "texture"])
        names.update((record["object"], record["texture"]) for record in _different(records))
    return {description_of(ObjectRecord(0, *each)) for each in names} - {""}


def _different(table: pa.Table) -> list[dict[str, str]]:
    """Return the different rows of a table."""
    return table.group_by(table.column_names).aggregate([]).to_pylist()
