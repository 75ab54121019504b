"""`openvima data info`: what a folder of demonstrations holds."""

import json
from pathlib import Path
from typing import Annotated, Any

import tyro


def info(
    folder: Annotated[Path, tyro.conf.Positional],
    *,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Show how many episodes there are, of which tasks, made by what.

    Example: openvima data info demos

    Args:
        folder: Folder that `openvima generate` wrote.
        as_json: Print the manifest for machines.
    """
    from openvima.data.reader import Dataset

    manifest = Dataset(folder).manifest  # which also finds missing files
    print(json.dumps(manifest, indent=2) if as_json else _overview(folder, manifest))
    return 0


def _overview(folder: Path, manifest: dict[str, Any]) -> str:  # Any: JSON
    counts, config = manifest["counts"], manifest["config"]
    size_mb = sum(file.stat().st_size for file in folder.iterdir() if file.is_file()) / 1e6
    lines = [
        f"{folder}: {counts['episodes']} episodes, {counts['steps']} steps, "
        f"{counts['shards']} shards, {size_mb:.1f} MB",
        f"level {config['level']}, domain {config['domain']}, seeds from {config['start_seed']}, "
        f"assets {config['assets']}, {config['difficulty']}{', compat' if config['compat'] else ''}",
        ", ".join(f"{name} {version}" for name, version in sorted(manifest["versions"].items())),
        "",
        f"{'task':<28}{'episodes':>10}{'steps':>8}{'seeds tried':>13}{'oracle success':>16}{'redraws':>9}",
    ]
    for task, entry in manifest["tasks"].items():
        lines.append(
            f"{task:<28}{entry['episodes']:>10}{entry['steps']:>8}{entry['seeds_tried']:>13}"
            f"{entry['success_rate']:>16.1%}{entry['redraws']:>9}"
        )
    return "\n".join(lines)
