"""Pages of notebooks: scripts in jupytext's percent format, with the outputs of their cells."""

import ast
import base64
import contextlib
import io
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path

CELL = re.compile(r"^# %%(.*)$", re.MULTILINE)


@dataclass(frozen=True)
class Cell:
    """One cell of a notebook."""

    is_code: bool
    text: str


def cells(script: str) -> Iterator[Cell]:
    """Yield the cells of a script in the percent format."""
    _, *parts = CELL.split(script)
    for mark, text in zip(parts[::2], parts[1::2], strict=True):
        is_code = "[markdown]" not in mark
        text = text.strip("\n")
        yield Cell(is_code, text if is_code else re.sub(r"^# ?", "", text, flags=re.MULTILINE))


def notebook_page(path: Path, *, execute: bool) -> str:
    """Return a notebook as Markdown.

    Args:
        path: The script.
        execute: Whether to run it, in an empty folder, and to show what its cells return and print.
    """
    names: dict[str, object] = {"__name__": "__main__"}
    parts = []
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for cell in cells(path.read_text(encoding="utf-8")):
            if not cell.is_code:
                parts.append(cell.text)
                continue
            parts.append(f"```python\n{cell.text}\n```")
            if execute:
                parts += filter(None, run(cell.text, names, str(path)))
    return "\n\n".join(parts) + "\n"


def run(code: str, names: dict[str, object], where: str) -> tuple[str, str]:
    """Run a cell as a notebook does.

    Args:
        code: Statements; the value of a last expression is shown.
        names: Variables of the notebook; changed.
        where: File name for tracebacks.

    Returns:
        What it printed and what it returned, as Markdown.
    """
    tree = ast.parse(code)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    value = None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, where, "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), where, "eval"), names)
    return text_output(printed.getvalue()), "" if value is None else shown(value)


def text_output(text: str) -> str:
    """Show plain text as the output of a cell."""
    return f'<pre class="output">{escape(text.rstrip())}</pre>' if text.strip() else ""


def shown(value: object) -> str:
    """Show a value by its richest representation: HTML, PNG or text."""
    html = getattr(value, "_repr_html_", lambda: None)()
    if html:
        return f'<div class="output">{" ".join(html.split())}</div>'
    png = getattr(value, "_repr_png_", lambda: None)()
    if png:
        data = base64.b64encode(png).decode("ascii")
        return f'<div class="output"><img alt="Output of the cell" src="data:image/png;base64,{data}"></div>'
    return text_output(repr(value))
