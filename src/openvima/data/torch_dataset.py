"""Demonstrations for PyTorch: by number, or as a stream of batches that can go on where it stopped."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info

from openvima.data.batching import BatchOrder
from openvima.data.reader import Dataset as Demonstrations
from openvima.data.records import Demonstration
from openvima.errors import ConfigError
from openvima.scene import ACTION_SHAPES

Episode = TypeVar("Episode")
# Episodes of a batch and its number to whatever the user's training step takes (Any).
Transform = Callable[[list[Episode], int], Any]


class DemonstrationDataset(Dataset):
    """Whole demonstrations with their images, by number.

    Args:
        demonstrations: The folder of demonstrations.
        transform: Turns a demonstration into an item; by default `tensors_of`.

    Example:
        >>> items = DemonstrationDataset(openvima.data.Dataset("demos"))
        >>> items[0]["rgb_top"].shape
        torch.Size([2, 3, 128, 256])
    """

    def __init__(
        self, demonstrations: Demonstrations, transform: Callable[[Demonstration], Any] | None = None
    ) -> None:
        self.demonstrations = demonstrations
        self.transform = transform or tensors_of

    def __len__(self) -> int:
        return len(self.demonstrations)

    def __getitem__(self, index: int) -> Any:  # Any: what `transform` returns
        return self.transform(self.demonstrations[index])


def tensors_of(demo: Demonstration) -> dict[str, Any]:  # Any: tensors, texts and numbers
    """Return a demonstration of T steps as a dictionary of tensors.

    Returns:
        `rgb_front`, `rgb_top` (T + 1, 3, 128, 256) uint8; `segm_front`, `segm_top` (T + 1, 128, 256) uint8;
        `pose0_position`, `pose1_position` (T, 2) and `pose0_rotation`, `pose1_rotation` (T, 4) float32;
        `pick_ids`, `place_ids` (T,) int64; `prompt`, the text; `prompt_images`, for each placeholder the
        same four images without the time axis; `task`, `seed` and `end_effector`.
    """
    item: dict[str, Any] = {
        "task": demo.task,
        "seed": demo.seed,
        "end_effector": demo.end_effector,
        "prompt": demo.prompt.text,
        "prompt_images": {name: _images(image.rgb, image.segm) for name, image in demo.prompt.images.items()},
        **_images(demo.rgb, demo.segm),
        "pick_ids": torch.tensor(demo.pick_ids, dtype=torch.int64),
        "place_ids": torch.tensor(demo.place_ids, dtype=torch.int64),
    }
    for key, width in ACTION_SHAPES.items():
        rows = np.array([getattr(action, key) for action in demo.actions], np.float32)
        item[key] = torch.from_numpy(rows.reshape(-1, width))
    return item


def _images(rgb: dict[str, np.ndarray], segm: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    named = {f"rgb_{view}": images for view, images in rgb.items()}
    named |= {f"segm_{view}": images for view, images in segm.items()}
    return {name: torch.from_numpy(np.array(images)) for name, images in named.items()}


class BatchStream(IterableDataset, Generic[Episode]):
    """Batches of episodes in a given order; loader workers share them out.

    Worker w of W takes every W-th batch. A `DataLoader` asks its workers in turn, so the batches come in the
    same order whatever their number.

    Args:
        source: Episodes by number: a `ObjectCache`, or a `Dataset` for those with images.
        order: Which of them each batch takes.
        first: Number of the first batch.
        stop: Number of the batch before which to stop; None goes on for ever.
        transform: Turns a list of episodes into a batch; by default the list itself is the batch. It is also
            given the number of the batch, for what it may draw at random. It is sent to the workers, so that
            it must be a function of a module or an object that can be pickled.
    """

    def __init__(
        self,
        source: Sequence[Episode],
        order: BatchOrder,
        *,
        first: int = 0,
        stop: int | None = None,
        transform: Transform[Episode] | None = None,
    ) -> None:
        self.source, self.order, self.transform = source, order, transform
        self.first, self.stop = first, stop

    def __iter__(self) -> Iterator[Any]:  # Any: see `Transform`
        worker = get_worker_info()
        number, stride = (self.first, 1) if worker is None else (self.first + worker.id, worker.num_workers)
        while self.stop is None or number < self.stop:
            episodes = [self.source[int(row)] for row in self.order.rows(number)]
            yield episodes if self.transform is None else self.transform(episodes, number)
            number += stride


class BatchLoader(Generic[Episode]):
    """Iterates over batches, and knows where it is.

    `for batch in loader` goes to the end of the epoch, and the next such loop through the next one;
    `loader.forever()` goes on without an end and without starting workers anew.

    Args:
        source: Episodes by number: a `ObjectCache`, or a `Dataset` for those with images.
        order: Which of them each batch takes.
        transform: Turns a list of episodes into a batch; see `BatchStream`.
        workers: Processes that read ahead; 0 reads when asked.
        context: How they start: "fork", "spawn" or "forkserver"; by default as the system does.
        pin_memory: Put tensors into memory from which a GPU copies faster.

    Raises:
        ConfigError: The order is for another number of episodes.

    Example:
        >>> cache = open_object_cache(Dataset("demos"))
        >>> order = BatchOrder(len(cache), batch=64, seed=0, lengths=cache.lengths())
        >>> loader = BatchLoader(cache, order, workers=2)
        >>> for episodes in loader: ...
        >>> torch.save(loader.state_dict(), "position.pt")
    """

    def __init__(
        self,
        source: Sequence[Episode],
        order: BatchOrder,
        *,
        transform: Transform[Episode] | None = None,
        workers: int = 0,
        context: str | None = None,
        pin_memory: bool = False,
    ) -> None:
        if len(source) != order.num_episodes:
            raise ConfigError(f"the order is for {order.num_episodes} episodes; there are {len(source)}.")
        self.source, self.order, self.transform = source, order, transform
        self._options = {
            "num_workers": workers,
            "multiprocessing_context": context if workers else None,
            "pin_memory": pin_memory,
        }
        self._num_done = 0

    def __len__(self) -> int:
        return self.order.batches_per_epoch

    @property
    def epoch(self) -> int:
        """Number of whole epochs that were shown."""
        return self._num_done // len(self)

    def __iter__(self) -> Iterator[Any]:  # Any: see `Transform`
        return self._batches((self.epoch + 1) * len(self))

    def forever(self) -> Iterator[Any]:  # Any: see `Transform`
        """Yield batches of epoch after epoch."""
        return self._batches(None)

    def state_dict(self) -> dict[str, Any]:  # Any: numbers and settings
        """Return the position: batches that were shown, not those that were read ahead."""
        return {"batches": self._num_done, "order": self.order.settings()}

    def load_state_dict(self, state: dict[str, Any]) -> None:  # Any: as above
        """Go on from a position; the number of workers and of ranks may have changed.

        Raises:
            ConfigError: It belongs to another order.
        """
        ours = self.order.settings()
        differences = [
            f"{name} was {state['order'].get(name)}, is {value}"
            for name, value in ours.items()
            if state["order"].get(name) != value
        ]
        if differences:
            raise ConfigError(f"the position belongs to another order: {'; '.join(differences)}.")
        self._num_done = int(state["batches"])

    def _batches(self, stop: int | None) -> Iterator[Any]:  # Any: see `Transform`
        stream = BatchStream(
            self.source, self.order, first=self._num_done, stop=stop, transform=self.transform
        )
        for batch in batches_of(stream, **self._options):
            self._num_done += 1
            yield batch


def batches_of(stream: BatchStream, **options: Any) -> DataLoader:  # Any: of several kinds
    """Return what reads the batches of a stream, perhaps ahead.

    Args:
        stream: The batches; they come as they are, untouched by PyTorch's ways of collating.
        **options: Of `DataLoader`, such as `num_workers`.
    """
    # Without a generator it would draw from the global one.
    return DataLoader(stream, batch_size=None, collate_fn=_unchanged, generator=torch.Generator(), **options)


def _unchanged(batch: Any) -> Any:  # Any: see `Transform`; PyTorch's default would turn tuples into lists
    return batch
