"""The texts of a run, of which the vocabulary of its network is built."""

from openvima.data.reader import Dataset
from openvima.perception.preprocessing import split_prompt
from openvima.tasks.novel_words import NOUNS
from openvima.training.augmentation.inverse_dynamics import motion_text
from openvima.training.augmentation.prompt_images import DEFINITION
from openvima.training.config import AugmentationConfig


def training_texts(dataset: Dataset, augmentation: AugmentationConfig) -> set[str]:
    """Return the different texts between the placeholders of the prompts, and those of the augmentation.

    Args:
        dataset: The demonstrations; of these only the prompts are read.
        augmentation: Settings; an inverse-dynamics prompt and novel nouns bring words of their own.

    Raises:
        ShardError: A shard is damaged.
    """
    prompts: set[str] = set()
    for name in dataset.shard_names():
        prompts.update(dataset.shard(name).table(["prompt"]).column("prompt").unique().to_pylist())
    if augmentation.inverse_dynamics_prob:
        prompts.add(motion_text(1))
    if augmentation.rename_objects_prob:
        prompts.update(DEFINITION.format(noun=f"the {noun}", image="") for noun in NOUNS)
    return {piece for prompt in prompts for piece in split_prompt(prompt) if isinstance(piece, str)}
