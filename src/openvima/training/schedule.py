"""The learning rate over a run, and random generators that follow from the step alone."""

import hashlib
import math

import torch


def learning_rate_at(
    step: int,
    *,
    highest: float,
    steps: int,
    warmup_steps: int,
    decay_steps: int | None = None,
    final: float = 0.0,
) -> float:
    """Learning rate of one step.

    It rises linearly over the warm-up, falls along half a cosine, and then stays where it is.

    Args:
        step: Steps done, from 0.
        highest: Learning rate after the warm-up.
        steps: Steps of the whole run.
        warmup_steps: Steps of the rise; at most a third of the run counts.
        decay_steps: Steps of the fall; None, or more than are left, is to the end of the run.
        final: Where the fall ends; at most `highest`.
    """
    warmup_steps = min(warmup_steps, steps // 3)
    if step < warmup_steps:
        return highest * (step + 1) / (warmup_steps + 1)
    left = max(1, steps - warmup_steps)
    progress = min(1.0, (step - warmup_steps) / min(left, decay_steps or left))
    final = min(final, highest)
    return final + (highest - final) * 0.5 * (1 + math.cos(math.pi * progress))


def step_seed(seed: int, purpose: str, step: int) -> int:
    """Seed for what one step of a run draws for one purpose.

    A resumed run needs no saved generators: every draw follows from the run's seed and the step's number.
    """
    digest = hashlib.blake2b(f"{seed}/{purpose}/{step}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def step_generator(seed: int, purpose: str, step: int) -> torch.Generator:
    """Generator seeded by `step_seed`."""
    return torch.Generator().manual_seed(step_seed(seed, purpose, step))
