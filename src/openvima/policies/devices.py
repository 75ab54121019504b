"""Devices and number of threads."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from openvima.errors import PolicyError


def usable_device(device: torch.device | str) -> torch.device:
    """Return a device after checking that it works.

    For a GPU, cuDNN's attention is turned off in this process: it plans anew for each shape, and those of
    prompts and histories vary (`results/2026-11-26_gpu.md`).

    Raises:
        PolicyError: The device is not available.
    """
    try:
        found = torch.device(device)
        torch.zeros(1, device=found).item()  # raises on "meta", too, whose tensors have no values
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise PolicyError(
            f"device {str(device)!r} cannot be used here; allowed: cpu, and cuda on a machine with a GPU for "
            "which torch is installed."
        ) from error
    if found.type == "cuda":
        torch.backends.cuda.enable_cudnn_sdp(False)
    return found


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set the number of threads; it changes the summation order, and so the last bits of results."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
