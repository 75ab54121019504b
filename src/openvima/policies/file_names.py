"""File names in checkpoint folders and run folders."""

from pathlib import Path

WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.yaml"
TOKENIZER_FOLDER = "tokenizer"
CHECKPOINTS_FOLDER = "checkpoints"
BEST_FILE = "best.txt"  # in the checkpoints folder; contains the name of the best one


def checkpoint_order(checkpoint: Path) -> tuple[str, int]:
    """Return a sort key of checkpoints: stage, then step, which may have more digits than the name pads."""
    stage, _, step = checkpoint.name.rpartition("-")
    return stage, int(step) if step.isdigit() else -1
