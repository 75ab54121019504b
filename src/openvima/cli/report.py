"""`openvima report`: one page, or tables for a paper, from the results of evaluations."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from openvima.cli.terminal import Json, parse_list


def main(
    results: Annotated[Positional[tuple[Path, ...]], arg(metavar="RESULTS")],
    *,
    out: Path | None = None,
    compare: str | None = None,
    runs: tuple[Path, ...] = (),
    published: bool = True,
    as_json: Json = False,
) -> None:
    """Write the report of one or several evaluations, as one HTML file that needs nothing else.

    Videos are those that the evaluations made. Policies of the same name that differ get that of their folder
    too, as in mine@first.

    Example: openvima report first second --compare mine@first,mine@second --out report.html

    Args:
        results: Folders of evaluations, or their results.json.
        out: File to write: .html, or .md or .tex for the tables of a paper; by default report.html beside
            the results, or in the current folder if there are several.
        compare: Policies with commas in between; each is compared with the first, seed by seed.
            POLICY:ABLATION stands for its score under an ablation.
        runs: Folders of training runs, or their metrics.jsonl, whose learning curves to show.
        published: Whether to show published numbers of the same tasks beside those measured.
        as_json: Print the comparisons as JSON.
    """
    from openvima.atomic_io import atomic_write_file
    from openvima.errors import ConfigError
    from openvima.evaluation.comparison import compare_pairs, default_pairs, merge
    from openvima.evaluation.results import Results
    from openvima.evaluation.verification import is_marked_verified
    from openvima.report import write_report
    from openvima.report.curves import run_labels
    from openvima.report.page import default_command
    from openvima.report.table import latex, markdown
    from openvima.report.tables import paper_tables
    from openvima.report.text import finding
    from openvima.report.videos import REPORT_NAME, require_extra
    from openvima.video.encoder import load_clips

    if not results:
        raise ConfigError("give at least one folder of an evaluation, or a results.json.")
    paths = list(dict.fromkeys(results))
    folders = [path if path.is_dir() else path.parent for path in paths]
    is_single = len(paths) == 1
    # Several have no place in common, and each may have a report of its own.
    page = out or (folders[0] if is_single else Path()) / REPORT_NAME
    writers = {".html": None, ".md": markdown, ".tex": latex}
    if page.suffix.lower() not in writers:
        raise ConfigError(
            f"--out is {str(out)!r}; give the name of an HTML file, such as report.html, or one that ends in "
            ".md or .tex for tables."
        )
    # A single evaluation has no name, so that its report is the one that `evaluate` wrote, wherever it lies.
    labels = ["DIR"] if is_single else run_labels(folders)
    evaluations = dict(zip(labels, map(Results.read, paths), strict=True))
    merged = merge(evaluations)
    if compare is None:
        pairs = default_pairs(merged.results)
    else:
        first, *others = parse_list(compare) or ("",)
        if not others:
            raise ConfigError(f"--compare is {compare!r}; give two or more policies with commas in between.")
        pairs = [(first, other) for other in others]
    comparisons = compare_pairs(merged.results, pairs)
    confirmations = dict(zip(labels, map(is_marked_verified, paths), strict=True))
    if write := writers[page.suffix.lower()]:
        confirmed = all(confirmations.values())
        tables = paper_tables(merged.results, comparisons, published=published, confirmed=confirmed)
        atomic_write_file(page, write(tables))
        print(f"Tables: {page}")
        return
    if as_json:
        print(json.dumps([comparison.record() for comparison in comparisons], indent=1))
    said = sys.stderr if as_json else sys.stdout  # what is printed for other programs has stdout to itself
    if compare is not None:
        for comparison in comparisons:
            for difference in comparison.means:
                print(finding(comparison, difference), file=said)
    if out is None and as_json:
        return
    require_extra()
    clips = [
        replace(clip, policy=names.get(clip.policy, clip.policy))  # as in the common report
        for folder, names in zip(folders, merged.names.values(), strict=True)
        for clip in load_clips(folder)
    ]
    write_report(
        merged.results,
        page,
        command="\n".join(default_command(found) for found in evaluations.values()),
        runs=runs,
        clips=clips,
        comparisons=comparisons,
        notes=merged.notes,
        with_published=published,
        confirmations=confirmations,
    )
    print(f"Report: {page}", file=said)
