"""Demonstrations for PyTorch: by number, or as a stream of batches that can go on where it stopped."""

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import DataLoader, Dataset, IterableDataset, get_worker_info
from torch.utils.data._utils.collate import default_collate_fn_map  # documented with `default_collate`

from openvima.data.batching import BatchOrder
from openvima.data.reader import Dataset as Demonstrations
from openvima.data.records import Demonstration
from openvima.data.torch_batches import sent
from openvima.errors import ConfigError, ShapeError
from openvima.scene import ACTION_SHAPES
from openvima.scene.scene import BACKGROUND_ID

Episode = TypeVar("Episode")
# Episodes of a batch and its number to whatever the user's training step takes (Any).
Transform = Callable[[list[Episode], int], Any]


class DemonstrationDataset(Dataset):
    """Whole demonstrations with their images, by number.

    A plain `DataLoader` makes batches of them, with any number of workers: items of `tensors_of` are joined
    by `collate`. A slice is a `DemonstrationDataset` of those demonstrations.

    Args:
        demonstrations: The folder of demonstrations, or its path.
        transform: Turns a demonstration into an item; by default `tensors_of`. For workers that are spawned
            it must be a function of a module or an object that can be pickled.

    Raises:
        DatasetError: The folder is no finished data set.

    Example:
        >>> items = DemonstrationDataset("demos")
        >>> items[0]["rgb_top"].shape
        torch.Size([2, 3, 128, 256])
        >>> batch = next(iter(DataLoader(items[:100], batch_size=8)))
        >>> batch["rgb_top"].shape
        torch.Size([8, 4, 3, 128, 256])
    """

    def __init__(
        self,
        demonstrations: Demonstrations | str | Path,
        transform: Callable[[Demonstration], Any] | None = None,
    ) -> None:
        given = demonstrations
        self.demonstrations = given if isinstance(given, Demonstrations) else Demonstrations(given)
        self.transform = transform or tensors_of
        self._rows = range(len(self.demonstrations))

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int | slice) -> Any:  # Any: what `transform` returns, or a part of these
        if isinstance(index, slice):
            part = copy(self)
            part._rows = self._rows[index]
            return part
        try:
            row = self._rows[index]
        except IndexError:
            last = len(self) - 1
            raise IndexError(f"episode {index} of {len(self)}; count from 0 to {last}.") from None
        return self.transform(self.demonstrations[row])


class DemonstrationTensors(dict[str, Any]):  # Any: tensors, texts and numbers
    """A demonstration as `tensors_of` returns it, of a type that `DataLoader` collates by `collate`."""


def tensors_of(demo: Demonstration) -> DemonstrationTensors:
    """Return a demonstration of T steps as a dictionary of tensors.

    Returns:
        `rgb_front`, `rgb_top` (T + 1, 3, 128, 256) uint8; `segm_front`, `segm_top` (T + 1, 128, 256) uint8;
        `pose0_position`, `pose1_position` (T, 2) and `pose0_rotation`, `pose1_rotation` (T, 4) float32;
        `pick_ids`, `place_ids` (T,) int64; `prompt`, the text; `prompt_images`, for each placeholder the
        same four images without the time axis; `task`, `seed` and `end_effector`.
    """
    item = DemonstrationTensors(
        task=demo.task,
        seed=demo.seed,
        end_effector=demo.end_effector,
        prompt=demo.prompt.text,
        prompt_images={name: _images(image.rgb, image.segm) for name, image in demo.prompt.images.items()},
        **_images(demo.rgb, demo.segm),
        pick_ids=torch.tensor(demo.pick_ids, dtype=torch.int64),
        place_ids=torch.tensor(demo.place_ids, dtype=torch.int64),
    )
    for key, width in ACTION_SHAPES.items():
        rows = np.array([getattr(action, key) for action in demo.actions], np.float32)
        item[key] = torch.from_numpy(rows.reshape(-1, width))
    return item


def collate(items: Sequence[DemonstrationTensors]) -> dict[str, Any]:  # Any: tensors, texts and numbers
    """Join B demonstrations to a batch; a plain `DataLoader` does so by itself.

    Args:
        items: As `tensors_of` returns them; the longest has T steps, the longest prompt P images.

    Returns:
        `rgb_front`, `rgb_top` (B, T + 1, 3, 128, 256) and `segm_front`, `segm_top` (B, T + 1, 128, 256)
        uint8; `pose0_position`, `pose1_position` (B, T, 2) and `pose0_rotation`, `pose1_rotation` (B, T, 4)
        float32; `pick_ids`, `place_ids` (B, T) int64; `mask` (B, T) bool, which steps exist;
        `prompt_rgb_front`, `prompt_rgb_top` (B, P, 3, 128, 256) and `prompt_segm_front`, `prompt_segm_top`
        (B, P, 128, 256) uint8; `prompt_mask` (B, P) bool, which prompt images exist. Lists of B entries:
        `prompt`, `prompt_names` (names of the prompt images), `task`, `seed` and `end_effector`.
        Padding is 0, in segmentations 255 (nothing), in ids −1.

    Raises:
        ShapeError: There are no items.
    """
    if not items:
        raise ShapeError("collate got no demonstrations; give at least one.")
    images = [list(item["prompt_images"].values()) for item in items]
    batch: dict[str, Any] = {
        **{name: [item[name] for item in items] for name in ("prompt", "task", "seed", "end_effector")},
        "prompt_names": [list(item["prompt_images"]) for item in items],
        "mask": _padded([torch.ones(len(item["pick_ids"]), dtype=torch.bool) for item in items], 0),
        "prompt_mask": _padded([torch.ones(len(shown), dtype=torch.bool) for shown in images], 0),
    }
    for name in (name for name, value in items[0].items() if isinstance(value, torch.Tensor)):
        batch[name] = _padded([item[name] for item in items], _padding(name))
        if name.startswith(("rgb", "segm")):
            blank = items[0][name][:0]
            shown = [torch.stack([image[name] for image in found]) if found else blank for found in images]
            batch[f"prompt_{name}"] = _padded(shown, _padding(name))
    return sent(batch)


def _padding(name: str) -> int:
    return BACKGROUND_ID if name.startswith("segm") else -1 if name.endswith("_ids") else 0


def _padded(tensors: list[torch.Tensor], value: int) -> torch.Tensor:
    return pad_sequence(tensors, batch_first=True, padding_value=value)


def _collate_items(batch: Sequence[DemonstrationTensors], *, collate_fn_map: Any = None) -> dict[str, Any]:
    """The form in which `DataLoader` looks up how to collate a type; Any: see `collate`."""
    return collate(batch)


default_collate_fn_map[DemonstrationTensors] = _collate_items


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
        num_workers: Processes that read ahead; 0 reads when asked.
        context: How they start: "fork", "spawn" or "forkserver"; by default as the system does.
        pin_memory: Put tensors into memory from which a GPU copies faster.

    Raises:
        ConfigError: The order is for another number of episodes.

    Example:
        >>> cache = open_object_cache(Dataset("demos"))
        >>> order = BatchOrder(len(cache), batch_size=64, seed=0, lengths=cache.lengths())
        >>> loader = BatchLoader(cache, order, num_workers=2)
        >>> for episodes in loader: ...
        >>> torch.save(loader.state_dict(), "position.pt")
    """

    def __init__(
        self,
        source: Sequence[Episode],
        order: BatchOrder,
        *,
        transform: Transform[Episode] | None = None,
        num_workers: int = 0,
        context: str | None = None,
        pin_memory: bool = False,
    ) -> None:
        if len(source) != order.num_episodes:
            raise ConfigError(f"the order is for {order.num_episodes} episodes; there are {len(source)}.")
        self.source, self.order, self.transform = source, order, transform
        self._options = {
            "num_workers": num_workers,
            "multiprocessing_context": context if num_workers else None,
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
    return sent(batch)
