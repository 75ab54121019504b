"""`openvima verify-results`: confirm an evaluation from its recorded actions."""

import json

from openvima.cli.options import Folder, Json
from openvima.cli.terminal import progress_bar

MAX_SHOWN = 20


def main(
    folder: Folder,
    *,
    workers: int = 1,
    assets: str | None = None,
    as_json: Json = False,
) -> int:
    """Confirm every outcome of an evaluation without its policy.

    Each episode is sampled from its seed again, and the recorded actions are executed. Exit status 0 if all
    is confirmed, else 1. Who acted, and what they observed, is declared by the file and not proven.

    Example: openvima verify-results evaluation --workers 2

    Args:
        folder: Folder of an evaluation, with results.json and actions.arrow.
        workers: Number of processes.
        assets: Folder of the original benchmark's assets, or FILE.py:FUNCTION, for results obtained with
            them.
        as_json: Print the result as JSON.

    Returns:
        Exit status.
    """
    from openvima.evaluation.verification import verify_results

    with progress_bar("verifying") as report:
        found = verify_results(folder, workers=workers, assets=assets, report=report)
    if as_json:
        print(json.dumps(found.record(), indent=2, ensure_ascii=False))
        return 0 if found.is_verified else 1
    if found.is_verified:
        print(
            f"{folder}: {found.episodes:,} episodes confirmed by their actions; sha256 {found.sha256[:16]}…"
        )
        print(f"declared, not proven: {found.declared}")
        print(f"to submit: results.json and actions.arrow, {found.num_bytes / 1e6:.1f} MB")
        return 0
    print(f"{folder}: not confirmed, {len(found.problems)} contradictions")
    for problem in found.problems[:MAX_SHOWN]:
        print(f"  {problem}")
    if len(found.problems) > MAX_SHOWN:
        print(f"  and {len(found.problems) - MAX_SHOWN} more; --json lists all")
    return 1
