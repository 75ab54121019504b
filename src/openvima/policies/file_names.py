"""Names of the files of a checkpoint folder, and where a run folder keeps such folders."""

WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.yaml"
TOKENIZER_FOLDER = "tokenizer"
CHECKPOINTS_FOLDER = "checkpoints"
BEST_FILE = "best.txt"  # in the checkpoints folder: name of the best one
