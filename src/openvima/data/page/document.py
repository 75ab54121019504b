"""The page as a whole: one HTML file that needs nothing else, no network, no scripts, no other files."""

import html
import json
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path

import numpy as np

from openvima.atomic_io import atomic_write_file
from openvima.data.page.charts import bar_chart
from openvima.data.page.episodes import episode_card
from openvima.data.reader import Dataset
from openvima.data.summary import Overview, TaskOverview
from openvima.errors import AssetError, ConfigError, ShardError

MAX_SAMPLES = 50  # of each task; a page with more is too large for a browser

Report = Callable[[int, int, str], None]


def write_page(overview: Overview, out: Path, *, num_samples: int = 3, report: Report | None = None) -> Path:
    """Write the page on a data set; equal data give equal bytes.

    Args:
        overview: The data set in numbers.
        out: The HTML file to write.
        num_samples: Episodes of each task to show, spread evenly over those that there are.
        report: Called with episodes drawn, episodes to draw, and a note.

    Returns:
        The file.

    Raises:
        ConfigError: The number of samples is out of range.
        ShardError: The data set is damaged.
    """
    if not 0 <= num_samples <= MAX_SAMPLES:
        raise ConfigError(f"samples is {num_samples}; it must lie within 0 … {MAX_SAMPLES}.")
    sections = (
        _at_a_glance(overview),
        _task_table(overview.tasks),
        _histograms(overview),
        _episodes(overview, num_samples, report or (lambda done, total, note: None)),
        _provenance(overview),
    )
    return atomic_write_file(out, _document(overview, "\n".join(section for section in sections if section)))


def _document(overview: Overview, body: str) -> str:
    style = resources.files("openvima.data.page").joinpath("style.css").read_text(encoding="utf-8")
    counts = overview.manifest["counts"]
    num_tasks = len(overview.tasks)
    headline = f"{counts['episodes']:,} demonstrations of {num_tasks} task{'' if num_tasks == 1 else 's'}"
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{headline} · openvima</title>\n"
        f'<link rel="icon" href="data:,">\n<style>\n{style}</style>\n</head>\n<body>\n'
        '<header><div><div class="eyebrow">openvima data set</div>'
        f"<h1>{headline}</h1>"
        "<p>A robot arm is told what to do by a prompt that mixes words with images, and a scripted solver "
        "that sees the true scene shows how. Each demonstration holds the prompt, what two cameras saw "
        "before and after each step, the actions, and where every object was.</p></div></header>\n"
        f"<main>\n{body}\n</main>\n"
        f"<footer><div>openvima {_text(overview.manifest['versions'].get('openvima', ''))} · all images come "
        "from the data set itself.</div></footer>\n</body>\n</html>\n"
    )


def _at_a_glance(overview: Overview) -> str:
    counts = overview.manifest["counts"]
    tiles = {
        "episodes": f"{counts['episodes']:,}",
        "steps": f"{counts['steps']:,}",
        "files": f"{counts['shards']:,}",
        "size": _size(overview.file_bytes),
        "per episode": _size(overview.file_bytes / max(1, counts["episodes"])),
    }
    if overview.num_failed is not None:
        tiles["failed ones kept apart"] = f"{overview.num_failed:,}"
    body = "".join(f"<div><b>{value}</b><span>{name}</span></div>" for name, value in tiles.items())
    return f'<section id="overview"><div class="card tiles">{body}</div></section>'


def _task_table(tasks: Sequence[TaskOverview]) -> str:
    head = ("task", "episodes", "steps", "kB / episode", "images", "seeds tried", "oracle success", "redraws")
    cells = "".join(f'<th scope="col">{name}</th>' for name in head)
    rows = "".join(
        f'<tr><th scope="row">{_breakable(task.task)}</th><td>{task.episodes:,}</td><td>{task.steps:,}</td>'
        f"<td>{task.bytes / max(1, task.episodes) / 1e3:.1f}</td><td>{task.image_share:.0%}</td>"
        f"<td>{task.seeds_tried:,}</td><td>{task.success_rate:.1%}</td><td>{task.redraws:,}</td></tr>"
        for task in tasks
    )
    return _section(
        "tasks",
        "Tasks",
        "Images: their share in the bytes. Seeds whose episode the solver spoilt are not kept, only counted; "
        "redraws are unlucky draws that the sampler threw away.",
        f'<div class="card scroll"><table><thead><tr>{cells}</tr></thead><tbody>{rows}</tbody></table></div>',
    )


def _histograms(overview: Overview) -> str:
    figures = "".join(
        f'<figure class="card"><h3>{_text(histogram.title.capitalize())}</h3>{bar_chart(histogram)}</figure>'
        for histogram in overview.histograms
        if len(histogram.counts) > 1
    )
    return _section(
        "histograms",
        "What is in them",
        "Numbers of episodes, and of objects on the table where it says so.",
        f'<div class="charts">{figures}</div>',
    )


def _episodes(overview: Overview, num_samples: int, report: Report) -> str:
    if not num_samples:
        return ""
    dataset = Dataset(overview.folder)
    task_of = np.array(dataset.index.column("task").to_pylist(), dtype=str)
    chosen = {
        task.task: _spread(np.flatnonzero(task_of == task.task), num_samples) for task in overview.tasks
    }
    total, done = sum(map(len, chosen.values())), 0
    parts = []
    for task, episodes in chosen.items():
        cards = []
        for episode_index in episodes:
            cards.append(_card(dataset, episode_index))
            done += 1
            report(done, total, task)
        parts.append(f'<h3 id="task-{_text(task)}">{_breakable(task)}</h3>{"".join(cards)}')
    links = " ".join(f'<a href="#task-{_text(task)}">{_breakable(task)}</a>' for task in chosen)
    return _section(
        "episodes",
        "Episodes to look at",
        "The prompt as a policy reads it; then what the front camera (above) and the top camera (below) saw, "
        "and what the arm did: it reached down at the ring and let go, or stopped, at the arrow's head.",
        f'<p class="links">{links}</p>{"".join(parts)}',
    )


def _spread(numbers: np.ndarray, count: int) -> list[int]:
    places = np.arange(min(count, len(numbers))) * len(numbers) // max(1, min(count, len(numbers)))
    return numbers[places].tolist()


def _card(dataset: Dataset, episode_index: int) -> str:
    try:
        return episode_card(dataset[episode_index])
    except (AssetError, ShardError) as error:  # stored without images, and not to be redrawn here
        if dataset.shard(dataset.locate(episode_index)[0]).info.images:
            raise
        return f'<article class="card"><p>{_text(str(error))}</p></article>'


def _provenance(overview: Overview) -> str:
    manifest = overview.manifest
    versions = "".join(
        f"<li>{_text(name)} <b>{_text(number)}</b></li>"
        for name, number in sorted(manifest["versions"].items())
    )
    caches = "".join(
        f"<li>token cache {_text(name)} <b>{_size(size)}</b></li>"
        for name, size in overview.token_caches.items()
    )
    settings = json.dumps(manifest["config"], indent=2, ensure_ascii=False)
    return _section(
        "provenance",
        "Where it comes from",
        "Equal settings and versions give equal bytes; the manifest holds a checksum of each file.",
        f'<div class="card"><p>Written by <code>{_text(manifest["command"])}</code>, content '
        f"<code>{_text(manifest['content_hash'])}</code>, licence {_text(manifest['licence'])}, with these "
        f"settings:</p><pre><code>{_text(settings)}</code></pre>"
        f'<ul class="versions">{versions}{caches}</ul></div>',
    )


def _section(name: str, title: str, lead: str, body: str) -> str:
    return f'<section id="{name}"><h2>{title}</h2><p>{lead}</p>{body}</section>'


def _size(num_bytes: float) -> str:
    for unit in ("B", "kB", "MB"):
        if num_bytes < 1000:
            return f"{num_bytes:.3g} {unit}"
        num_bytes /= 1000
    return f"{num_bytes:,.1f} GB"


def _text(text: str) -> str:
    return html.escape(text)


def _breakable(name: str) -> str:
    """Let long names break after their underscores."""
    return html.escape(name).replace("_", "_<wbr>")
