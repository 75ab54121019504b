"""Make docs/reliability.md of the latest results of `faults.py` and `long_day.py`.

python benchmarks/reliability_page.py [--results DIR] [--out FILE]
"""

import json
from pathlib import Path
from typing import Any

from fault_campaign import KINDS
from fault_cases import CASES, READ_ONLY
from performance_table import write_page

ROOT = Path(__file__).parents[1]
MAX_WORDS = 10  # of a command that is shown whole
PAGE = ROOT / "docs" / "reliability.md"
_HERE = "the faults below"
# Promise, and where it is tested.
PROMISES = (
    (
        "A file under its final name is whole: the old one, the new one, or none. Unfinished ones are hidden "
        "and end in `.tmp`, `.partial` or `.old`.",
        (_HERE, "tests/test_atomic_io.py"),
    ),
    ("Exit status 0 means that everything was written.", (_HERE,)),
    (
        "An error of disk or memory is one line that names the path and what to do; no traceback.",
        (_HERE, "tests/cli/test_main.py"),
    ),
    (
        "After any of it, the same command finishes, with the same bytes as an undisturbed one, and deletes "
        "what was left.",
        (_HERE, "tests/data/test_generation_faults.py", "tests/training/test_kill.py"),
    ),
    (
        "Replacing (`--force`) keeps the old output until the new one is whole. `train --force` and "
        "`generate --force` delete it first.",
        (_HERE, "tests/test_atomic_io.py"),
    ),
    ("Content is on the disk before its final name is, so a power cut leaves no empty files.", (_HERE,)),
    (
        "A killed worker process ends the command with one line; files that were finished stay.",
        (_HERE, "tests/test_multiprocess.py"),
    ),
    ("A clock that jumps changes no content.", (_HERE,)),
    (
        "Two commands never write to one folder at the same time.",
        ("tests/test_folder_lock.py", "tests/data/test_one_writer.py"),
    ),
    (
        "Damage to data, caches and checkpoints is found when they are read.",
        ("benchmarks/damage_data.py", "tests/data/test_object_cache.py", "benchmarks/attack_checkpoints.py"),
    ),
    (
        "A policy server, evaluations and vector environments run for hours: no answer is lost or wrong, "
        "memory grows by at most 5 %, and handles and threads do not accumulate.",
        ("benchmarks/long_day.py", "tests/serving/test_batching.py"),
    ),
)
HEAD = """# Reliability

What a command leaves behind when a disk fills up, a process is killed or the power fails, and how that is
tested. Made from {source} by `python benchmarks/reliability_page.py`; do not edit.

## Promises

| promise | tested by |
|---|---|
{promises}

Files whose content depends on time or machine have `log` in their names; they are exempt from "the same
bytes". A last line of `metrics.jsonl` that was cut is repaired when the run goes on.

## Faults

`benchmarks/faults.py` runs each command in small. A seccomp filter stops it at each system call that changes
a file, native libraries and worker processes included, and decides what happens (Linux on x86-64). The clean
run is counted first. Among calls alike, such as all writes to files whose names differ by a number, the
first, the last and some between are taken: the "points".

| fault | what is done |
|---|---|
| kill | What the files are just before the call, as SIGKILL would leave them. |
| torn write | The same, with the first half of the bytes of the write. |
| power cut | The same, with each file cut to what was synced. Renames are taken to be kept in order. |
| full disk | Half of the write happens, then this and all later calls that need space fail (`ENOSPC`). |
| I/O error | This one call fails (`EIO`), also the deletions and renames. |
| no memory | From some mapping of 256 KiB or more on, all of them fail. |
| clock jump | Each reading of the clock is a day later or earlier. |
| killed worker | SIGKILL to a worker process of `--workers 2`, at a call of any process. |

After each: exit status and message; all visible files are as before, as they end up, or read as whole by a
reader of their format; nothing that was there is lost. Then the same command is run again, once for each
distinct content of the folder, and has to end with the bytes of the undisturbed run.

## Outcomes

`PYTHONPATH=tests python benchmarks/faults.py --json FILE` injects the faults. The table is of a sample: one
or two points for each kind of call (`--per-label`), and at most 10 to 16 in all for slow commands. `calls` is
what `--per-label 0`, which was not run, would take. {totals}
A cell is the number of faults that were harmless + those after which the same command finished; a third
number counts broken promises.

| command | calls | points | {kinds} | states |
|---|---:|---:|{rule}---:|
"""


def page(results: Path) -> str:
    """Return docs/reliability.md."""
    file = sorted(results.glob("*_faults.json"))[-1]
    cases = json.loads(file.read_text(encoding="utf-8"))["cases"]
    head = HEAD.format(
        source=f"[results](../results/{file.with_suffix('.md').name})",
        promises="\n".join(f"| {promise} | {_places(places)} |" for promise, places in PROMISES),
        totals=totals(cases),
        kinds=" | ".join(KINDS),
        rule="---:|" * len(KINDS),
    )
    read_only = "\n".join(f"| `{verb}` | {reason} |" for verb, reason in READ_ONLY.items())
    return (
        head
        + "".join(f"{_row(case)}\n" for case in cases)
        + f"\nVerbs that write nothing:\n\n| verb | why |\n|---|---|\n{read_only}\n"
        + "".join(long_day(file) for file in sorted(results.glob("*_long_day.json"))[-1:])
    )


def long_day(file: Path) -> str:
    """Return the section about hours of a policy server, evaluations and vector environments."""
    result = json.loads(file.read_text(encoding="utf-8"))
    rows = [
        f"| {each['what']} | {'yes' if each['good'] else '**no**'} | {each['found']} |"
        for each in result["verdicts"]
    ]
    lines = [
        "",
        "## Endurance test",
        "",
        f"`{result['command']}` keeps a policy server, an evaluation and vector environments busy "
        f"([record and plots](../results/{file.with_suffix('.md').name})):",
        "",
        "| promise | held | found |",
        "|---|---|---|",
        *rows,
    ]
    return "\n".join(lines) + "\n"


def totals(cases: list[dict[str, Any]]) -> str:  # Any: JSON
    """Return one sentence with the sums over all commands."""
    counts = [count for case in cases for count in case["kinds"].values()]
    sums = {name: sum(count[name] for count in counts) for name in ("injected", "failed")}
    points, states = (sum(case[name] for case in cases) for name in ("points", "states"))
    return (
        f"{sums['injected']:,} faults at {points:,} points of {len(cases)} of {len(CASES)} commands left "
        f"{states:,} different contents; {sums['failed']:,} broke a promise."
    )


def _places(places: tuple[str, ...]) -> str:
    return ", ".join(place if place == _HERE else f"`{place}`" for place in places)


def _row(case: dict[str, Any]) -> str:  # Any: JSON
    cells = [_cell(case["kinds"].get(kind)) for kind in KINDS]
    words = case["case"].split()
    if len(words) > MAX_WORDS:
        words = [*words[:3], "…", *words[-3:]]
    named = [f"`{' '.join(words)}`", case["calls"], case["points"], *cells, case["states"]]
    return f"| {' | '.join(map(str, named))} |"


def _cell(count: dict[str, int] | None) -> str:
    if count is None:
        return "–"
    failed = f" + **{count['failed']}**" if count["failed"] else ""
    return f"{count['harmless']} + {count['resumed']}{failed}"


if __name__ == "__main__":
    write_page(__doc__, page, PAGE)
