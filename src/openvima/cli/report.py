"""`openvima report`: make the HTML report of evaluation results."""

from pathlib import Path

import tyro


def main(
    results: tyro.conf.Positional[Path],
    *,
    out: Path | None = None,
    metrics: Path | None = None,
) -> int:
    """Write the report of an evaluation once more, as one HTML file that needs nothing else.

    Films are those that the evaluation made.

    Example: openvima report evaluation --metrics runs/first/metrics.jsonl

    Args:
        results: Folder of an evaluation, or a results.json.
        out: HTML file to write; by default report.html beside the results.
        metrics: Training record whose curves to show.

    Returns:
        Exit status.
    """
    from openvima.errors import ConfigError, DatasetError
    from openvima.evaluation.clips import load_clips
    from openvima.evaluation.finish import REPORT_NAME, require_extra
    from openvima.evaluation.report import write_report
    from openvima.evaluation.results import Results

    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"--out is {str(out)!r}; give the name of an HTML file, such as report.html.")
    require_extra()
    found = Results.read(results)
    if metrics is not None and not metrics.is_file():
        raise DatasetError(f"there is no {metrics}; give the metrics.jsonl of a training run.")
    folder = results if results.is_dir() else results.parent
    path = write_report(found, out or folder / REPORT_NAME, metrics=metrics, clips=load_clips(folder))
    print(f"Report: {path}")
    return 0
