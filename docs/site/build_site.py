"""Build the documentation site: `python docs/site/build_site.py --out site`.

Pages of `docs`, recorded results and what they link to are staged in a temporary folder beside generated
pages: tasks, Python API, notebooks with their outputs. Zensical turns them into HTML. Warnings, such as
a link without a target, are errors.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

from notebook_pages import notebook_page
from reference_pages import public_names, reference_pages
from task_pages import write_task_pages

ROOT = Path(__file__).parents[2]
NAMED = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "docs/README.md": "pages.md",
    "results/README.md": "results/index.md",
}
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")
OPTION = re.compile(r"`(--[\w.-]+( [\w.-]+)?)`")
NO_RUN = re.compile(r"^(```\w+) .*$", re.MULTILINE)  # a mark for the tests
LANGUAGES = {".py": "python", ".yaml": "yaml", ".toml": "toml", ".json": "json"}


def site_path(path: str) -> str:
    """Return where a file or folder of the repository is on the site."""
    if (ROOT / path).is_dir():
        return f"{path}/index.md"
    if path in NAMED:
        return NAMED[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    if path.startswith("notebooks/"):
        return f"{path.rpartition('.')[0]}.md"
    return path if path.endswith((".md", ".png", ".webp")) else f"{path}.md"


class Pages:
    """Stages files of the repository, and those that they link to.

    Args:
        folder: Where they go.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.staged: set[str] = set()

    def add(self, path: str) -> None:
        """Stage a file or folder of the repository, by its path there."""
        if path in self.staged or path.startswith("notebooks/"):
            return
        self.staged.add(path)
        source = ROOT / path
        if source.suffix in (".png", ".webp"):
            target = self.folder / site_path(path)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
        elif source.is_dir():
            self.write(site_path(path), folder_page(source))
        elif source.suffix == ".md":
            self.write(site_path(path), self.with_site_links(path, source.read_text(encoding="utf-8")))
        else:
            self.write(site_path(path), code_page(path, source.read_text(encoding="utf-8")))

    def write(self, name: str, text: str) -> None:
        """Write a page by its path on the site."""
        target = self.folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")

    def with_site_links(self, path: str, text: str) -> str:
        """Point the links of a page to the site, and stage what they lead to."""
        here = site_path(path)

        def replace(link: re.Match[str]) -> str:
            target = ((ROOT / path).parent / link[1]).resolve().relative_to(ROOT).as_posix()
            self.add(target)
            up = "../" * here.count("/")
            return f"]({up}{site_path(target)}{link[2] or ''})"

        parts = FENCE.split(text)
        fences = [NO_RUN.sub(r"\1", block[0]) for block in FENCE.finditer(text)]
        linked = [OPTION.sub(r"`\1`{ .option }", LINK.sub(replace, part)) for part in parts]
        return "".join(part + fence for part, fence in zip(linked, [*fences, ""], strict=True))


def code_page(path: str, text: str) -> str:
    """Show a file; searches leave it out."""
    language = LANGUAGES.get(Path(path).suffix, "text")
    return f"---\nsearch:\n  exclude: true\n---\n# {path}\n\n````{language}\n{text}````\n"


def folder_page(folder: Path) -> str:
    """List the files of a folder."""
    names = sorted(file.name for file in folder.iterdir() if not file.name.startswith(("_", ".")))
    return f"# {folder.relative_to(ROOT)}\n\n" + "\n".join(f"- `{name}`" for name in names) + "\n"


def stage(folder: Path, *, execute: bool) -> dict:
    """Write all pages and return the site's settings.

    Args:
        folder: Where the pages go; emptied first.
        execute: Whether to run the notebooks; without, their pages have no outputs.
    """
    shutil.rmtree(folder, ignore_errors=True)
    pages = Pages(folder)
    for file in (*ROOT.glob("docs/*.md"), *ROOT.glob("docs/images/*.png"), *ROOT.glob("results/*.md")):
        pages.add(file.relative_to(ROOT).as_posix())
    for name in NAMED:
        pages.add(name)
    for name, text in reference_pages(public_names()).items():
        pages.write(name, text)
    for notebook in sorted(ROOT.glob("notebooks/*.py")):
        pages.write(f"notebooks/{notebook.stem}.md", notebook_page(notebook, execute=execute))
    write_task_pages(folder / "tasks")
    shutil.copy(Path(__file__).parent / "site.css", folder)
    text = (Path(__file__).parent / "site.yml").read_text("utf-8").replace("../..", ROOT.as_posix())
    settings = yaml.load(text, yaml.UnsafeLoader)
    settings["nav"] = navigation(settings["nav"], folder)
    return settings


def navigation(nav: list, folder: Path) -> list:
    """Replace folders by their pages, and put pages of `docs` that no section names into the last one."""
    named = set(re.findall(r"[\w/]+\.md", str(nav)))
    last = next(iter(nav[-1].values()))
    last += sorted({file.name for file in folder.glob("*.md")} - named)
    return [_with_pages(entry, folder) for entry in nav]


def _with_pages(entry: str | dict, folder: Path) -> str | dict:
    if isinstance(entry, str):
        return entry
    ((title, pages),) = entry.items()
    if isinstance(pages, list):
        return {title: [_with_pages(page, folder) for page in pages]}
    files = sorted((folder / pages).glob("*.md"), key=lambda file: (file.name != "index.md", file.name))
    return {title: [file.relative_to(folder).as_posix() for file in files]}


def build(out: Path, *, execute: bool = True) -> None:
    """Build the site.

    Args:
        out: Folder of the HTML; replaced.
        execute: Whether to run the notebooks.
    """
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        settings = stage(folder / "pages", execute=execute)
        settings |= {"docs_dir": "pages", "site_dir": "html"}
        (folder / "mkdocs.yml").write_text(yaml.dump(settings, sort_keys=False), encoding="utf-8")
        command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
        subprocess.run([*command, "--config-file", str(folder / "mkdocs.yml")], check=True)
        shutil.copytree(folder / "html", out, dirs_exist_ok=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "site")
    parser.add_argument("--no-execute", action="store_true", help="show notebooks without outputs")
    arguments = parser.parse_args()
    build(arguments.out, execute=not arguments.no_execute)
