"""Make docs/performance.md, one table of the performance figures recorded in results/.

    python benchmarks/performance_table.py

A result is a file results/YYYY-MM-DD_NAME.json, with NAME.md beside it. For each figure that belongs in the
table it has one entry in its top-level list "performance":

    {"performance": [{"what": "VIMA-200M, decision 5, against no KV cache", "value": 3.9, "unit": "×",
                      "command": "python benchmarks/policy.py", "commit": "9270b8e", "against": "39ff454"}]}

what:    What was measured; the key of the row. A newer result replaces the row of an older one.
value:   A number, or a text such as "9 to 27".
unit:    "episodes/s", "ms", "%", "×", ….
command: The command that measures it.
commit:  The commit that was measured.
against: Only for a ratio of two commits: the commit before, measured in the same run.

The date is that of the file's name. Rows are in the order of the files, then of their entries. Ratios of two
commits, and figures whose script no longer exists, stay in the records alone.
"""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "performance.md"
HEAD = """# Performance

The newest figures of each kind. Each is that of the machine in its record, where command and commit are.
Made by `python benchmarks/performance_table.py`; do not edit.

| what | figure |
|---|---:|
"""


def page(results: Path) -> str:
    """Return docs/performance.md, with the newest row of each figure."""
    rows: dict[str, str] = {}
    for file in sorted(results.glob("*.json")):
        for entry in json.loads(file.read_text(encoding="utf-8")).get("performance", ()):
            rows.pop(entry["what"], None)
            scripts = re.findall(r"benchmarks/\w+\.py", entry["command"])
            if "against" not in entry and all((ROOT / script).exists() for script in scripts):
                rows[entry["what"]] = _row(entry, file.with_suffix(".md").name)
    return HEAD + "".join(rows.values())


def _row(entry: dict, record: str) -> str:
    value, unit = entry["value"], entry["unit"]
    figure = f"{value if isinstance(value, str) else f'{value:,}'}{'' if unit == '×' else ' '}{unit}"
    return f"| {entry['what']} | [{figure}](../results/{record}) |\n"


if __name__ == "__main__":
    PAGE.write_text(page(ROOT / "results"), encoding="utf-8")
