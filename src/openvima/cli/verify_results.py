"""`openvima verify-results`: confirm an evaluation from its recorded actions."""

from openvima.cli.terminal import Folder, progress_bar


def main(
    folder: Folder,
    *,
    workers: int = 1,
    assets: str | None = None,
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

    Returns:
        Exit status.
    """
    from openvima.evaluation.results import DECLARED
    from openvima.evaluation.verification import verify_results

    with progress_bar("verifying") as report:
        found = verify_results(folder, workers=workers, assets=assets, report=report)
    if found.is_verified:
        print(
            f"{folder}: {found.episodes:,} episodes confirmed by their actions; sha256 {found.sha256[:16]}…"
        )
        print(f"declared, not proven: {DECLARED}")
        return 0
    print(f"{folder}: not confirmed, {len(found.problems)} contradictions")
    for problem in found.problems:
        print(f"  {problem}")
    return 1
