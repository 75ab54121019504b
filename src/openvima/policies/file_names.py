"""File names in checkpoint folders and run folders."""

WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.yaml"
TOKENIZER_FOLDER = "tokenizer"
CHECKPOINTS_FOLDER = "checkpoints"
BEST_FILE = "best.txt"  # in the checkpoints folder; contains the name of the best one
