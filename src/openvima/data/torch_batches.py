"""How batches of a loader's workers reach the main process: in shared memory, or else through the pipe.

PyTorch moves tensors to shared memory when a thread of the worker sends them. If there is no room, as in a
container with Docker's 64 MB of `/dev/shm`, that thread drops the batch and the main process waits for ever.
"""

import io
import math
import os
import pickle
from typing import Any

import torch
from torch.utils.data import get_worker_info


def sent(batch: Any) -> Any:  # Any: whatever the user's training step takes
    """Return a batch that the main process gets, whether or not there is room in shared memory.

    Args:
        batch: What a worker has made; in any other process it is returned as it is.
    """
    if get_worker_info() is None:
        return batch
    finder = _TensorFinder(_Nowhere(), pickle.HIGHEST_PROTOCOL, buffer_callback=lambda buffer: None)
    finder.dump(batch)
    tensors = [tensor for tensor in finder.found if not tensor.is_shared()]
    if 2 * sum(tensor.untyped_storage().nbytes() for tensor in tensors) > _room():  # others fill it, too
        return _Inline(batch)
    try:
        for tensor in tensors:
            tensor.share_memory_()
    except RuntimeError as error:
        if "shared memory" not in str(error):
            raise
        return _Inline(batch)
    return batch


def _room() -> float:
    """Return the free bytes of shared memory, where they are known: a failed attempt leaves an empty file."""
    try:
        status = os.statvfs("/dev/shm")
    except (AttributeError, OSError):
        return math.inf
    return status.f_bavail * status.f_frsize


class _Inline:
    """A batch that is sent with its numbers; the main process gets the batch itself.

    Args:
        batch: The batch.
    """

    def __init__(self, batch: Any) -> None:  # Any: see `sent`
        self._content = pickle.dumps(batch, pickle.HIGHEST_PROTOCOL)

    def __reduce__(self) -> tuple[Any, ...]:  # Any: what pickle takes
        return pickle.loads, (self._content,)


class _TensorFinder(pickle.Pickler):
    """Finds the tensors in what it writes."""

    def __init__(self, *args: Any, **options: Any) -> None:  # Any: as for `Pickler`
        super().__init__(*args, **options)
        self.found: list[torch.Tensor] = []

    def persistent_id(self, obj: Any) -> Any:  # Any: as in pickle
        """Note a tensor, and write nothing of it."""
        if not isinstance(obj, torch.Tensor):
            return None
        if obj.device.type == "cpu" and obj.layout == torch.strided:
            self.found.append(obj)
        return "tensor"


class _Nowhere(io.RawIOBase):
    """Takes what is written, and keeps nothing."""

    def write(self, content: Any, /) -> int:  # Any: a buffer
        """Return its length."""
        return len(content)
