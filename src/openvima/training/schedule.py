"""Learning rate schedule, and random generators derived from the step."""

import hashlib
import math

import torch

from openvima.training.config import ScheduleConfig


def learning_rate_at(step: int, schedule: ScheduleConfig, *, peak: float, num_steps: int) -> float:
    """Return the learning rate of a step: linear warm-up, cosine decay, then constant.

    Args:
        step: Steps done, from 0.
        schedule: Its warm-up counts up to a third of the run, its decay up to the end of the run, its final
            rate up to the peak.
        peak: Learning rate after the warm-up.
        num_steps: Steps of the whole run.
    """
    warmup_steps = min(schedule.warmup_steps, num_steps // 3)
    if step < warmup_steps:
        return peak * (step + 1) / (warmup_steps + 1)
    left = max(1, num_steps - warmup_steps)
    progress = min(1.0, (step - warmup_steps) / min(left, schedule.decay_steps or left))
    final = min(schedule.final_learning_rate, peak)
    return final + (peak - final) * 0.5 * (1 + math.cos(math.pi * progress))


def step_seed(seed: int, purpose: str, step: int) -> int:
    """Return the seed of one purpose at one step, so that a resumed run needs no saved generators."""
    digest = hashlib.blake2b(f"{seed}/{purpose}/{step}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def step_generator(seed: int, purpose: str, step: int) -> torch.Generator:
    """Return a generator seeded by `step_seed`."""
    return torch.Generator().manual_seed(step_seed(seed, purpose, step))
