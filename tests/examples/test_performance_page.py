"""docs/performance.md is what `benchmarks/performance_table.py` makes of the recorded results."""

import json
from pathlib import Path

import pytest

from performance_table import PAGE, ROOT, RowError, page

ENTRY = {
    "what": "decision",
    "value": 12.5,
    "unit": "ms",
    "command": "python benchmarks/sim.py",
    "commit": "abc",
}


def record(folder: Path, name: str, *entries: dict) -> None:
    (folder / name).write_text(json.dumps({"performance": entries}), encoding="utf-8")


def test_the_page_is_made_from_the_results() -> None:
    made = page(ROOT / "results")
    assert PAGE.read_text(encoding="utf-8") == made, "run python benchmarks/performance_table.py"


def test_a_newer_result_replaces_the_row(tmp_path: Path) -> None:
    gone = {"what": "gone", "command": "python benchmarks/that_is_gone.py"}
    record(tmp_path, "2026-01-01_a.json", ENTRY, ENTRY | {"what": "other", "value": "9 to 27"}, ENTRY | gone)
    ratio = {"what": "in turns", "unit": "×", "against": "def"}
    record(tmp_path, "2026-01-02_b.json", ENTRY | {"value": 1.5, "unit": "×"}, ENTRY | ratio)
    assert page(tmp_path).splitlines()[-3:] == [
        "|---|---:|",
        "| other | [9 to 27 ms](../results/2026-01-01_a.md) |",
        "| decision | [1.5×](../results/2026-01-02_b.md) |",
    ]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ([ENTRY, ENTRY], "'decision' is in 2026-01-01_a.json of the same day"),
        ([ENTRY | {"speed": 1}], "does not have the fields what, value, unit, command, commit, against"),
        ([ENTRY | {"command": "a | b"}], "has a bar"),
    ],
)
def test_an_entry_that_does_not_fit_is_named(tmp_path: Path, entries: list[dict], message: str) -> None:
    record(tmp_path, "2026-01-01_a.json", *entries)
    with pytest.raises(RowError, match=message):
        page(tmp_path)
