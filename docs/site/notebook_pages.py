"""Notebooks with the outputs of their cells, from scripts in jupytext's percent format.

`python docs/site/notebook_pages.py` writes `notebooks/NAME.ipynb` beside each script, which GitHub shows;
the site has pages of them.
"""

import argparse
import ast
import base64
import contextlib
import io
import json
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from PIL import Image

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
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
    printed, value = execute(code, names, where)
    return text_output(printed), "" if value is None else shown(value)


def execute(code: str, names: dict[str, object], where: str) -> tuple[str, object]:
    """Run a cell as `run` does, and return what it printed and its value as they are."""
    tree = ast.parse(code)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    value = None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, where, "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), where, "eval"), names)
    return printed.getvalue(), value


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


def notebook(path: Path) -> dict[str, Any]:
    """Run a script and return it as a notebook, with the outputs of its cells (nbformat 4.5)."""
    names: dict[str, object] = {"__name__": "__main__"}
    written = []
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for number, cell in enumerate(cells(path.read_text(encoding="utf-8"))):
            about = {"id": f"cell-{number}", "metadata": {}, "source": cell.text.splitlines(keepends=True)}
            if cell.is_code:
                printed, value = execute(cell.text, names, str(path))
                outputs = [_stream(printed)] if printed.strip() else []
                outputs += [] if value is None else list(_displayed(value))
                about |= {"execution_count": None, "outputs": outputs}
            written.append({"cell_type": "code" if cell.is_code else "markdown"} | about)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    about = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": written, "metadata": about, "nbformat": 4, "nbformat_minor": 5}


def _stream(text: str) -> dict[str, Any]:
    return {"output_type": "stream", "name": "stdout", "text": text.splitlines(keepends=True)}


def _displayed(value: object) -> Iterator[dict[str, Any]]:
    """Yield the outputs of a value.

    GitHub drops styles from HTML and may drop pictures, so these follow as a picture of their own.
    """
    html = getattr(value, "_repr_html_", lambda: None)()
    png = getattr(value, "_repr_png_", lambda: None)()
    if html:
        encoded = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
        plain = re.sub(r"<style>.*?</style>|<figure>.*?</figure>", "", html, flags=re.DOTALL)
        plain = re.sub(r'<img [^>]*?title="(?:\w+: )?([^"]*)"[^>]*>', r"[\1]", plain)
        plain = re.sub(r'<span class="facts">(.*?)</span>', r" · \1", plain)
        yield _display({"text/html": " ".join(plain.split())})
        if encoded:
            yield _display({"image/png": _in_a_row([base64.b64decode(each) for each in encoded])})
    elif png:
        yield _display({"image/png": base64.b64encode(png).decode("ascii")})
    else:
        yield _display({"text/plain": repr(value)})


def _display(data: dict[str, str]) -> dict[str, Any]:
    return {"output_type": "display_data", "data": data, "metadata": {}}


def _in_a_row(pictures: list[bytes]) -> str:
    """Put PNG pictures side by side on white; return the PNG in base64."""
    images = [Image.open(io.BytesIO(picture)).convert("RGB") for picture in pictures]
    gap = 8
    width = sum(image.width + gap for image in images) - gap
    row = Image.new("RGB", (width, max(image.height for image in images)), "white")
    left = 0
    for image in images:
        row.paste(image, (left, row.height - image.height))
        left += image.width + gap
    file = io.BytesIO()
    row.save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode("ascii")


def write_notebooks(out: Path) -> None:
    """Write all notebooks, with outputs, to a folder."""
    for script in sorted(NOTEBOOKS.glob("*.py")):
        text = json.dumps(notebook(script), indent=1, ensure_ascii=False)
        (out / f"{script.stem}.ipynb").write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write notebooks/NAME.ipynb, with outputs.")
    parser.add_argument("--out", type=Path, default=NOTEBOOKS)
    write_notebooks(parser.parse_args().out)
