"""Published checkpoints of VIMA and its baselines: names, sizes and files."""
