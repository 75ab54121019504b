"""Inject faults into every verb that writes, at every writing system call, and check what is left.

    PYTHONPATH=tests python benchmarks/faults.py [--cases A,B] [--per-label N] [--json FILE]

The faults and what is checked are in docs/reliability.md, which `reliability_page.py` makes. Cases that FILE
holds already are kept, so that the work can be divided. Linux on x86-64.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fault_campaign import KINDS, Campaign, CaseRun, Outcome
from fault_cases import CASES, import_everything
from fault_injection import is_supported

ROOT = Path(__file__).parents[1]


def main() -> int:
    """Run the campaign; exit status 1 if a promise does not hold."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--cases", default="", help="comma-separated beginnings of command lines; all")
    parser.add_argument("--per-label", type=int, default=4, help="points among calls alike; 0: all")
    parser.add_argument("--max-points", type=int, default=0, help="points of each case; 0: no limit")
    parser.add_argument("--kinds", default=",".join(KINDS), help="kinds of faults")
    parser.add_argument("--json", type=Path, help="file to write")
    parser.add_argument("--light", action="store_true", help="begin at once, for cases without torch")
    options = parser.parse_args()
    if not is_supported():
        parser.error("this system does not let a process decide on the system calls of another")
    import_everything(with_torch=not options.light)
    asked, kinds = options.cases.split(","), tuple(options.kinds.split(","))
    num_failures = 0
    with tempfile.TemporaryDirectory() as folder:
        campaign = Campaign(Path(folder).resolve())
        for case in [case for words in asked for case in CASES if case.words.startswith(words)]:
            before = sum(os.times()[:4])
            limits = {"per_label": options.per_label, "max_points": options.max_points}
            outcome = CaseRun(campaign, case, kinds=kinds, **limits).all()
            print(_line(outcome, sum(os.times()[:4]) - before), *outcome.failures, sep="\n    ", flush=True)
            num_failures += len(outcome.failures)
            if options.json:
                _write(options.json, outcome, per_label=options.per_label)
    return 1 if num_failures else 0


def _line(outcome: Outcome, seconds: float) -> str:
    injected = sum(count.injected for count in outcome.kinds.values())
    return (
        f"openvima {outcome.case}: {outcome.calls} calls, {outcome.points} points, {injected} faults, "
        f"{outcome.states} states, {len(outcome.failures)} failures, {seconds:.0f} s"
    )


def _write(file: Path, outcome: Outcome, *, per_label: int) -> None:
    """Add an outcome to a file, in the order of the cases."""
    known: list[dict[str, Any]] = json.loads(file.read_text())["cases"] if file.exists() else []
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    entry = asdict(outcome) | {"per_label": per_label, "commit": commit.stdout.strip()}
    order = [case.words for case in CASES]
    found = {other["case"]: other for other in [*known, entry] if other["case"] in order}
    cases = sorted(found.values(), key=lambda other: order.index(other["case"]))
    content = {"command": "PYTHONPATH=tests python benchmarks/faults.py", "cases": cases}
    file.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
