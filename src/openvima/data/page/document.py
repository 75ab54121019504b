"""The data page: one self-contained HTML file without scripts."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from openvima.atomic_io import atomic_write_file
from openvima.data.page.charts import bar_chart
from openvima.data.page.episodes import episode_card
from openvima.data.reader import Dataset
from openvima.data.summary import Summary
from openvima.errors import AssetError, ConfigError, ShardError
from openvima.html import render_page, require_extra

MAX_SAMPLES = 50  # of each task; a page with more is too large for a browser

Report = Callable[[int, int, str], None]


def write_page(summary: Summary, out: Path, *, num_samples: int = 3, report: Report | None = None) -> Path:
    """Write the page of a data set; equal data give equal bytes.

    Args:
        summary: Statistics of the data set.
        out: The HTML file to write.
        num_samples: Episodes of each task on the page, evenly spread.
        report: Called with episodes drawn, episodes to draw, and a note.

    Returns:
        The file.

    Raises:
        ConfigError: The number of samples is out of range.
        ShardError: The data set is damaged.
    """
    if not 0 <= num_samples <= MAX_SAMPLES:
        raise ConfigError(f"samples is {num_samples}; it must lie within 0 … {MAX_SAMPLES}.")
    require_extra()
    counts, manifest = summary.manifest["counts"], summary.manifest
    tiles = {
        "episodes": f"{counts['episodes']:,}",
        "steps": f"{counts['steps']:,}",
        "files": f"{counts['shards']:,}",
        "size": _size(summary.file_bytes),
        "per episode": _size(summary.file_bytes / max(1, counts["episodes"])),
    }
    if summary.num_failed is not None:
        tiles["failed episodes kept apart"] = f"{summary.num_failed:,}"
    page = render_page(
        "dataset",
        counts=counts,
        manifest=manifest,
        tiles=tiles,
        tasks=summary.tasks,
        histograms=[bar_chart(histogram) for histogram in summary.histograms if len(histogram.counts) > 1],
        episodes=_episodes(summary, num_samples, report or (lambda done, total, note: None)),
        settings=json.dumps(manifest["config"], indent=2, ensure_ascii=False),
        caches={name: _size(size) for name, size in summary.object_caches.items()},
    )
    return atomic_write_file(out, page)


def _episodes(summary: Summary, num_samples: int, report: Report) -> dict[str, list[object]]:
    """Values of the template `episode` for some episodes of each task, or why one cannot be shown."""
    if not num_samples:
        return {}
    dataset = Dataset(summary.folder)
    task_of = np.array(dataset.index.column("task").to_pylist(), dtype=str)
    chosen = {task.task: _spread(np.flatnonzero(task_of == task.task), num_samples) for task in summary.tasks}
    total, done = sum(map(len, chosen.values())), 0
    cards: dict[str, list[object]] = {}
    for task, episodes in chosen.items():
        for episode_index in episodes:
            cards.setdefault(task, []).append(_card(dataset, episode_index))
            done += 1
            report(done, total, task)
    return cards


def _spread(numbers: np.ndarray, count: int) -> list[int]:
    places = np.arange(min(count, len(numbers))) * len(numbers) // max(1, min(count, len(numbers)))
    return numbers[places].tolist()


def _card(dataset: Dataset, episode_index: int) -> dict[str, object] | str:
    try:
        return episode_card(dataset[episode_index])
    except (AssetError, ShardError) as error:  # stored without images, which cannot be rerendered here
        if dataset.shard(dataset.locate(episode_index)[0]).info.images:
            raise
        return str(error)


def _size(num_bytes: float) -> str:
    for unit in ("B", "kB", "MB"):
        if num_bytes < 1000:
            return f"{num_bytes:.3g} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:,.1f} GB"
