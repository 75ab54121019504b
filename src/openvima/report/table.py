"""Tables as records, and written in Markdown and in LaTeX."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

_LATEX_TEXT = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "`": r"\textasciigrave{}",
    "−": "$-$",
    "≈": r"$\approx$",
}


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its interval, as fractions; written as percentages.

    Args:
        value: The number.
        interval: Its 95 % interval.
        signed: Whether it is a difference.
        mark: Put behind it.
    """

    value: float
    interval: tuple[float, float]
    signed: bool = False
    mark: str = ""

    @property
    def written(self) -> str:
        """The number, without a unit."""
        return self._percentage(self.value)

    @property
    def written_interval(self) -> str:
        """Its interval in words: "59.6 to 98.2"."""
        return " to ".join(map(self._percentage, self.interval))

    @property
    def brief(self) -> str:
        """The number with its interval in whole percent, for a terminal: "86.7 (60–98)"."""
        low, high = (round(100 * end) for end in self.interval)
        return f"{self.written} ({low}–{high}){f' {self.mark}' if self.mark else ''}"

    def _percentage(self, fraction: float) -> str:
        return f"{100 * fraction:{'+' if self.signed else ''}.1f}".replace("-", "−")


@dataclass(frozen=True, slots=True)
class Line:
    """A row of a table: its name, and as many cells as the table has columns besides."""

    name: str
    cells: tuple[Estimate | str, ...]
    starts_group: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """A table before it is written in any language.

    Args:
        label: Short name for references, of letters and hyphens.
        caption: The caption.
        columns: Heads, the first that of the names.
        lines: Rows.
    """

    label: str
    caption: str
    columns: tuple[str, ...]
    lines: tuple[Line, ...]


def markdown(tables: Sequence[Table]) -> str:
    """Write tables in Markdown, each with its caption above."""
    return "\n".join(_markdown_table(table) for table in tables)


def latex(tables: Sequence[Table]) -> str:
    r"""Write tables in LaTeX; they need `\usepackage{booktabs}`."""
    head = "% Needs \\usepackage{booktabs} and UTF-8 input; made with `openvima report`.\n"
    return head + "\n".join(_latex_table(table) for table in tables)


def latex_text(text: str) -> str:
    r"""Escape text for LaTeX.

    Example:
        >>> print(latex_text("follow_order: 50 %"))
        follow\_order: 50 \%
    """
    return text.translate(str.maketrans(_LATEX_TEXT))


def _markdown_table(table: Table) -> str:
    rows = [[line.name, *(_markdown_cell(cell) for cell in line.cells)] for line in table.lines]
    lines = [
        [_markdown_text(head) for head in table.columns],
        ["---", *["---:"] * (len(table.columns) - 1)],
        *[[_markdown_text(row[0]), *row[1:]] for row in rows],
    ]
    return f"{_markdown_text(table.caption)}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _markdown_cell(cell: Estimate | str) -> str:
    if isinstance(cell, str):
        return _markdown_text(cell)
    return f"{cell.written} ({cell.written_interval}){f' {cell.mark}' if cell.mark else ''}"


def _markdown_text(text: str) -> str:
    return re.sub(r"[\\|_*<`\[\]]", r"\\\g<0>", text)


def _latex_table(table: Table) -> str:
    rows = []
    for line in table.lines:
        rule = "\\midrule\n" if line.starts_group else ""
        cells = [latex_text(line.name), *(_latex_cell(cell) for cell in line.cells)]
        rows.append(f"{rule}{' & '.join(cells)} \\\\\n")
    head = " & ".join(latex_text(column) for column in table.columns)
    return (
        "\\begin{table}\n\\centering\n"
        f"\\caption{{{latex_text(table.caption)}}}\n\\label{{tab:{_label(table.label)}}}\n"
        f"\\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}\n\\toprule\n{head} \\\\\n\\midrule\n"
        f"{''.join(rows)}\\bottomrule\n\\end{{tabular}}\n\\end{{table}}\n"
    )


def _latex_cell(cell: Estimate | str) -> str:
    if isinstance(cell, str):
        return latex_text(cell)
    mark = f" {latex_text(cell.mark)}" if cell.mark else ""
    return f"{latex_text(cell.written)} {{\\footnotesize({latex_text(cell.written_interval)})}}{mark}"


def _label(text: str) -> str:
    """A name that LaTeX takes as a label: other letters become hyphens."""
    return re.sub("[^0-9A-Za-z]", "-", text)
