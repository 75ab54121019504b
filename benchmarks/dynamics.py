"""Agreement of the physics with VIMA-Bench: final poses of bodies after recorded actions.

    python benchmarks/dynamics.py --episodes FILE [FILE …] --assets DIR [--json FILE]

Replays every step of recorded episodes from its recorded start, with the original asset pack and the
benchmark's inexact arm (`compat`). `oracle` steps are clean solutions; `perturbed` ones rotate and shift
place poses, stack objects and miss picks. A body counts as moved from 5 mm on. Steps in which
other bodies moved, or one ended more than 20 mm elsewhere, are listed one by one.
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any

from golden_episodes import StepDifference, read_steps, replay, summary
from golden_scenes import RecordingError
from openvima.catalog.original import OriginalAssets
from openvima.errors import OpenVimaError


def main() -> None:
    """Replay all steps of a file, print tables, and write the result as JSON if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--episodes", type=Path, nargs="+", required=True, help="recorded episodes, such as episodes.json.gz"
    )
    parser.add_argument("--assets", type=Path, required=True, help="checkout with the original asset pack")
    parser.add_argument("--json", type=Path, help="file to write the result to")
    arguments = parser.parse_args()
    try:
        assets = OriginalAssets(arguments.assets)
        steps = [replay(step, assets) for file in arguments.episodes for step in read_steps(file)]
    except (RecordingError, OpenVimaError) as error:
        parser.error(str(error))
    modes = sorted({step.step.mode for step in steps})
    tasks = sorted({step.step.task for step in steps})
    result = {
        "modes": {mode: summary(s for s in steps if s.step.mode == mode) for mode in modes},
        "tasks": {
            task: {
                mode: summary(chosen)
                for mode in modes
                if (chosen := [s for s in steps if (s.step.task, s.step.mode) == (task, mode)])
            }
            for task in tasks
        },
        "differences": [_record(step) for step in steps if _is_notable(step)],
    }
    print(f"{'task':28} {'mode':10} steps  same moved  place error  yaw error  sweep error  (medians)")
    for task in tasks:
        for mode, row in result["tasks"][task].items():
            print(_row(task, mode, row))
    for mode, row in result["modes"].items():
        print(_row("all", mode, row))
    print("\nOther bodies moved, or one lies more than 20 mm elsewhere:")
    for record in result["differences"]:
        print(f"{record['mode']} {record['step']}: {'; '.join(record['bodies'])}")
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _row(task: str, mode: str, row: dict[str, float | int | None]) -> str:
    return (
        f"{task:28} {mode:10} {row['num_steps']:5d} {row['same_moved']:11.3f}"
        f"{_cell(row['place_error_mm_median'], 'mm', 13)}{_cell(row['yaw_error_deg_median'], '°', 11)}"
        f"{_cell(row['sweep_error_mm_median'], 'mm', 13)}"
    )


def _cell(value: float | int | None, unit: str, width: int) -> str:
    return f"{'–' if value is None else f'{value:.2f} {unit}':>{width}}"


def _is_notable(step: StepDifference) -> bool:
    return not step.same_moved or any(body.is_far for body in step.bodies)


def _record(step: StepDifference) -> dict[str, Any]:
    bodies = [
        f"{body.label} moved {body.moved_there_m * 1e3:.1f} mm there, {body.moved_here_m * 1e3:.1f} mm here, "
        f"{body.apart_m * 1e3:.1f} mm and {math.degrees(body.apart_rad):.0f}° apart"
        for body in step.bodies
        if body.is_far or body.moved_there != body.moved_here
    ]
    return {
        "step": step.step.name,
        "mode": step.step.mode,
        "same_moved": step.same_moved,
        "bodies": bodies,
    }


if __name__ == "__main__":
    main()
