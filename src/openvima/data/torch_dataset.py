"""Demonstrations for PyTorch: whole, with their images, by number.

Loader workers hand batches over through a pipe. PyTorch would move tensors to shared memory; if there is no
room, as in a container with Docker's 64 MB of `/dev/shm`, it drops the batch and the main process waits for
ever.
"""

import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import Dataset, get_worker_info
from torch.utils.data._utils.collate import default_collate_fn_map  # documented with `default_collate`

from openvima.data.reader import Dataset as Demonstrations
from openvima.data.records import Demonstration, action_arrays
from openvima.scene.scene import BACKGROUND_ID


class DemonstrationDataset(Dataset):
    """Whole demonstrations with their images, by number.

    A plain `DataLoader` makes batches of them, with any number of workers: items of `tensors_of` are joined
    by `collate`.

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
        >>> batch = next(iter(DataLoader(items, batch_size=8)))
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

    def __len__(self) -> int:
        return len(self.demonstrations)

    def __getitem__(self, index: int) -> Any:
        return self.transform(self.demonstrations[index])


class DemonstrationTensors(dict[str, Any]):
    """A demonstration as `tensors_of` returns it, of a type that `DataLoader` collates by `collate`."""


def tensors_of(demo: Demonstration) -> DemonstrationTensors:
    """Return a demonstration of T steps as a dictionary of tensors.

    Returns:
        `rgb_front`, `rgb_top` (T + 1, 3, 128, 256) uint8; `segm_front`, `segm_top` (T + 1, 128, 256) uint8;
        `pose0_position`, `pose1_position` (T, 2) and `pose0_rotation`, `pose1_rotation` (T, 4) float32;
        `pick_ids`, `place_ids` (T,) int64; `prompt`, the text; `prompt_images`, for each placeholder the
        same four images without the time axis; `task`, `seed` and `end_effector`.
    """
    return DemonstrationTensors(
        task=demo.task,
        seed=demo.seed,
        end_effector=demo.end_effector,
        prompt=demo.prompt.text,
        prompt_images={name: _images(image.rgb, image.segm) for name, image in demo.prompt.images.items()},
        **_images(demo.rgb, demo.segm),
        pick_ids=torch.tensor(demo.pick_ids, dtype=torch.int64),
        place_ids=torch.tensor(demo.place_ids, dtype=torch.int64),
        **{name: torch.from_numpy(rows) for name, rows in action_arrays(demo).items()},
    )


def collate(items: Sequence[DemonstrationTensors], *, collate_fn_map: object = None) -> dict[str, Any]:
    """Join B demonstrations to a batch; a plain `DataLoader` does so by itself.

    Args:
        items: As `tensors_of` returns them, at least one; the longest has T steps, the longest prompt P
            images.
        collate_fn_map: Not used; `DataLoader` gives it.

    Returns:
        `rgb_front`, `rgb_top` (B, T + 1, 3, 128, 256) and `segm_front`, `segm_top` (B, T + 1, 128, 256)
        uint8; `pose0_position`, `pose1_position` (B, T, 2) and `pose0_rotation`, `pose1_rotation` (B, T, 4)
        float32; `pick_ids`, `place_ids` (B, T) int64; `mask` (B, T) bool, which steps exist;
        `prompt_rgb_front`, `prompt_rgb_top` (B, P, 3, 128, 256) and `prompt_segm_front`, `prompt_segm_top`
        (B, P, 128, 256) uint8; `prompt_mask` (B, P) bool, which prompt images exist. Lists of B entries:
        `prompt`, `prompt_names` (names of the prompt images), `task`, `seed` and `end_effector`.
        Padding is 0, in segmentations 255 (nothing), in ids −1.
    """
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
    return send(batch)


def _padding(name: str) -> int:
    return BACKGROUND_ID if name.startswith("segm") else -1 if name.endswith("_ids") else 0


def _padded(tensors: list[torch.Tensor], value: int) -> torch.Tensor:
    return pad_sequence(tensors, batch_first=True, padding_value=value)


default_collate_fn_map[DemonstrationTensors] = collate


def _images(rgb: dict[str, np.ndarray], segm: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    named = {f"rgb_{view}": images for view, images in rgb.items()}
    named |= {f"segm_{view}": images for view, images in segm.items()}
    return {name: torch.from_numpy(np.array(images)) for name, images in named.items()}


def send(batch: Any) -> Any:
    """Return a batch in the form in which a loader worker sends it; the main process gets the batch itself.

    Args:
        batch: What a worker has made; in any other process it is returned as it is.
    """
    return batch if get_worker_info() is None else _Inline(batch)


class _Inline:
    """A batch that is sent with its numbers; the main process gets the batch itself.

    Args:
        batch: The batch.
    """

    def __init__(self, batch: Any) -> None:
        self._content = pickle.dumps(batch, pickle.HIGHEST_PROTOCOL)

    def __reduce__(self) -> tuple[Any, ...]:
        return pickle.loads, (self._content,)
