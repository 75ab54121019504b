"""Finding demonstrations in a data folder by task, level, length and what is on the table."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from openvima.catalog import LEVELS, OBJECTS, TEXTURES
from openvima.data.reader import Dataset
from openvima.errors import DatasetError, unknown_name


@dataclass(frozen=True, slots=True)
class DemonstrationQuery:
    """Which demonstrations to find; empty fields admit all.

    Args:
        task: Name of the task.
        level: "train" or "L1" to "L4".
        object: Object of the catalogue that is on the table.
        texture: Texture on the table; together with `object`, of that object.
        min_steps: Fewest steps.
        max_steps: Most steps; None for no limit.

    Raises:
        DatasetError: There is no such level, object or texture.
    """

    task: str = ""
    level: str = ""
    object: str = ""
    texture: str = ""
    min_steps: int = 0
    max_steps: int | None = None

    def __post_init__(self) -> None:
        known = {"level": LEVELS, "object": OBJECTS, "texture": TEXTURES}
        for field, names in known.items():
            if (name := getattr(self, field)) and name not in names:
                raise DatasetError(unknown_name(field, name, names))


def find_demonstrations(dataset: Dataset, query: DemonstrationQuery) -> np.ndarray:
    """Find demonstrations.

    Shards are read only for objects and textures, without images, and only those with candidates.

    Args:
        dataset: The data set.
        query: What to find.

    Returns:
        Indices into the data set, ascending, int64.

    Raises:
        DatasetError: The data set has no such task.
        ShardError: A shard is damaged.
    """
    index = dataset.index
    known = dataset.manifest["tasks"]
    if query.task and query.task not in known:
        raise DatasetError(unknown_name(f"task in {dataset.path} called", query.task, known))
    steps = index.column("steps").to_numpy()
    chosen = steps >= query.min_steps
    if query.max_steps is not None:
        chosen &= steps <= query.max_steps
    for field in ("task", "level"):
        if value := getattr(query, field):
            chosen &= index.column(field).to_numpy() == value
    found = np.flatnonzero(chosen)
    return _showing(dataset, found, query) if query.object or query.texture else found


def _showing(dataset: Dataset, candidates: np.ndarray, query: DemonstrationQuery) -> np.ndarray:
    """Keep the demonstrations with an object that fits."""
    rows: dict[str, list[tuple[int, int]]] = {}
    for index, (name, row) in zip(candidates.tolist(), dataset.locations(candidates), strict=True):
        rows.setdefault(name, []).append((index, row))
    kept = []
    for name, members in rows.items():
        lists = dataset.shard(name).table(["objects"]).column("objects").combine_chunks()
        objects: pa.StructArray = lists.flatten()
        fits = np.ones(len(objects), bool)
        for field in ("object", "texture"):
            if value := getattr(query, field):
                fits &= objects.field(field).to_numpy(zero_copy_only=False) == value
        owners = np.repeat(np.arange(len(lists)), lists.value_lengths().to_numpy())
        showing = set(owners[fits].tolist())
        kept += [index for index, row in members if row in showing]
    return np.array(sorted(kept), np.int64)
