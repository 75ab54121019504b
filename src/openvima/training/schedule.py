"""The learning rate over a run, and random generators that follow from the step alone."""

import hashlib
import math

import torch


def learning_rate_share(step: int, *, steps: int, warmup_steps: int) -> float:
    """Share of the highest learning rate at one step.

    It rises linearly over the warm-up and falls along half a cosine to 0 at the end of the run.

    Args:
        step: Steps done, from 0.
        steps: Steps of the whole run.
        warmup_steps: Steps of the rise; at most a third of the run counts.

    Returns:
        Between 0 and 1.
    """
    warmup_steps = min(warmup_steps, steps // 3)
    if step < warmup_steps:
        return (step + 1) / (warmup_steps + 1)
    progress = (step - warmup_steps) / max(1, steps - warmup_steps)
    return 0.5 * (1 + math.cos(math.pi * min(1.0, progress)))


def step_seed(seed: int, purpose: str, step: int) -> int:
    """Seed for what one step of a run draws for one purpose.

    A resumed run needs no saved generators: every draw follows from the run's seed and the step's number.
    """
    digest = hashlib.blake2b(f"{seed}/{purpose}/{step}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def step_generator(seed: int, purpose: str, step: int) -> torch.Generator:
    """Generator seeded by `step_seed`."""
    return torch.Generator().manual_seed(step_seed(seed, purpose, step))
