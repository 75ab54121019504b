"""The documentation site: it builds without a warning, no link is dead, every public name has an entry."""

import json
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from build_site import Pages, code_page, site_path
from notebook_pages import cells
from openvima.tasks import list_tasks, task_spec
from reference_pages import public_names

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))


class Page(HTMLParser):
    """Anchors and targets of a page.

    Args:
        path: The HTML file.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.targets: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("id", "name") and tag != "meta":
                self.ids.add(value or "")
            elif name in ("href", "src") and value is not None:
                self.targets.add(value)


def dead_links(site: Path) -> list[str]:
    """Return the links of a site's pages, without those to other sites, that lead nowhere."""
    pages = {path.resolve(): Page(path) for path in site.rglob("*.html") if path.name != "404.html"}
    dead = []
    for path, page in pages.items():
        for target in page.targets:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchor = unquote(parts.fragment)
            file = file / "index.html" if file.is_dir() else file
            known = anchor in pages[file].ids if anchor and file in pages else file.is_file()
            if not known:
                dead.append(f"{path.relative_to(site.resolve())}: {target}")
    return dead


@pytest.mark.slow
def test_the_site_builds_without_warnings_dead_links_and_missing_names(tmp_path: Path) -> None:
    pytest.importorskip("zensical", reason="the extra docs is not installed")
    command = [sys.executable, str(ROOT / "docs" / "site" / "build_site.py"), "--out", str(tmp_path)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    assert not dead_links(tmp_path)

    for package, names in public_names().items():
        ids = Page(tmp_path / "reference" / f"{package}.html").ids
        missing = [name for name in names if f"{package}.{name}" not in ids and name != "__version__"]
        assert not missing, f"{package}: {missing}"
    for task in list_tasks():
        page = (tmp_path / "tasks" / f"{task}.html").read_text(encoding="utf-8")
        assert all(f"images/{task}_{level}.png" in page for level in task_spec(task).levels)
        assert "<td>openvima-small</td>" in page
    for path in ROOT.glob("docs/*.md"):
        assert (tmp_path / site_path(f"docs/{path.name}")).with_suffix(".html").is_file()
    for notebook in NOTEBOOKS:
        page = (tmp_path / "notebooks" / f"{notebook.stem}.html").read_text(encoding="utf-8")
        assert page.count('class="output"') >= 4, notebook


def test_public_names_are_those_of_every_package_and_the_errors() -> None:
    names = public_names()
    assert {"make", "play", "compose"} <= set(names["openvima"])
    assert {"openvima.data.published", "openvima.evaluation.statistics"} <= names.keys()
    assert "ConfigError" in names["openvima.errors"] and "Iterable" not in names["openvima.errors"]
    assert sum(map(len, names.values())) > 250
    assert "openvima.wrappers" in names  # a module that pages import
    assert "ObjectExtractor" in names["openvima.perception.objects"]


def test_links_out_of_docs_lead_to_pages_of_the_site(tmp_path: Path) -> None:
    pages = Pages(tmp_path)
    block = "```python no-run\nx[0](1)\n```"
    text = f"[a](format.md#shards) [b](../examples/01_run_a_task.py)\n{block}\n[c](../results/)"
    assert pages.with_site_links("docs/reading.md", text) == (
        f"[a](format.md#shards) [b](examples/01_run_a_task.py.md)\n{block.replace(' no-run', '')}\n"
        "[c](results/index.md)"
    )
    code = (ROOT / "examples" / "01_run_a_task.py").read_text(encoding="utf-8")
    assert (tmp_path / "examples/01_run_a_task.py.md").read_text() == code_page(
        "examples/01_run_a_task.py", code
    )


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_a_title_and_code(notebook: Path) -> None:
    first, *others = cells(notebook.read_text(encoding="utf-8"))
    assert not first.is_code and first.text.startswith("# ")
    assert any(cell.is_code for cell in others)


def source(notebook: dict) -> list[tuple[str, str]]:
    return [(cell["cell_type"], "".join(cell["source"])) for cell in notebook["cells"]]


def outputs(notebook: dict) -> list[tuple[int, str]]:
    """Return the kinds of outputs, each with the number of its cell."""
    return [
        (number, kind)
        for number, cell in enumerate(notebook["cells"])
        for output in cell.get("outputs", ())
        for kind in output.get("data", ["text"])
    ]


@pytest.mark.parametrize("script", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebook_is_that_of_its_script_and_has_pictures(script: Path) -> None:
    notebook = json.loads(script.with_suffix(".ipynb").read_text(encoding="utf-8"))
    parts = cells(script.read_text(encoding="utf-8"))
    expected = [("code" if cell.is_code else "markdown", cell.text) for cell in parts]
    assert source(notebook) == expected, "run python docs/site/notebook_pages.py"
    assert "image/png" in {kind for _, kind in outputs(notebook)}


def test_notebooks_are_small() -> None:
    assert sum(path.with_suffix(".ipynb").stat().st_size for path in NOTEBOOKS) <= 1_500_000
