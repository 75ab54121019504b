"""How close our physics is to that of the public benchmark: where bodies lie after recorded actions.

    python benchmarks/dynamics.py --episodes FILE --assets DIR [--json FILE]

Replays every step of recorded episodes from its recorded start, with the original asset pack. `oracle` steps
are clean solutions; `perturbed` ones turn and shift places, put objects onto others and pick beside them.
"""

import argparse
import json
from pathlib import Path

from golden_episodes import Difference, read_steps, replay, summary
from openvima.catalog.original import OriginalAssets
from openvima.errors import AssetError


def main() -> None:
    """Replay all steps of a file, print a table, and write it as JSON if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=Path, required=True, help="recorded episodes, episodes.json.gz")
    parser.add_argument("--assets", type=Path, required=True, help="checkout with the original asset pack")
    parser.add_argument("--json", type=Path, help="file to write the result to")
    arguments = parser.parse_args()
    try:
        assets = OriginalAssets(arguments.assets)
    except AssetError as error:
        parser.error(str(error))
    if not arguments.episodes.is_file():
        parser.error(f"{arguments.episodes} is no file; give the recorded episodes")
    modes: dict[str, list[Difference]] = {}
    tasks: dict[str, list[Difference]] = {}
    for step in read_steps(arguments.episodes):
        differences = replay(step, assets)
        modes.setdefault(step.mode, []).extend(differences)
        tasks.setdefault(step.task, []).extend(differences)
    result = {
        "modes": {mode: summary(differences) for mode, differences in sorted(modes.items())},
        "tasks": {task: summary(differences) for task, differences in sorted(tasks.items()) if differences},
    }
    print(f"{'':28} bodies  same moved  place error  yaw error  sweep error  (medians)")
    for name, row in (*result["modes"].items(), *result["tasks"].items()):
        print(
            f"{name:28} {row['num_bodies']:6d} {row['same_moved']:11.3f}"
            f"{_cell(row['place_error_mm_median'], 'mm', 13)}{_cell(row['yaw_error_deg_median'], '°', 11)}"
            f"{_cell(row['sweep_error_mm_median'], 'mm', 13)}"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _cell(value: float | int | None, unit: str, width: int) -> str:
    return f"{'–' if value is None else f'{value:.2f} {unit}':>{width}}"


if __name__ == "__main__":
    main()
