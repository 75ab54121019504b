"""Every command line in the documentation parses, every option it names exists, every link has a target."""

import contextlib
import functools
import importlib
import io
import re
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import tyro

from openvima.cli.main import VERBS, main

ROOT = Path(__file__).parents[1]
PAGES = (*(ROOT / name for name in ("README.md", "CONTRIBUTING.md")), *sorted((ROOT / "docs").glob("*.md")))
README = (ROOT / "README.md").read_text(encoding="utf-8")
FENCE = re.compile(r"^```(\w*).*?\n(.*?)^```", re.MULTILINE | re.DOTALL)
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9.-]*")
OTHER_PROGRAMS = {"git", "pip", "pyright", "pytest", "python", "ray", "ruff", "sbatch", "torchrun"}
ELLIPSES = {"...", "…"}


@dataclass(frozen=True)
class Command:
    """A command line on a page: what follows `openvima`, and where it stands."""

    words: tuple[str, ...]
    where: str

    def __str__(self) -> str:
        return f"{self.where}: openvima {shlex.join(self.words)}"


class Parsed(BaseException):
    """Ends a command once its arguments are parsed, before any work."""


def commands(page: Path) -> Iterator[Command]:
    """Yield the commands of a page: lines of shell blocks, and code in running text."""
    text = page.read_text(encoding="utf-8")

    def where(position: int) -> str:
        return f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, position) + 1}"

    for block in FENCE.finditer(text):
        if block[1] not in ("", "sh", "bash", "console"):
            continue
        for line in re.finditer(r"(?:[^\n]*\\\n)*[^\n]+", block[2]):
            for words in openvima_calls(line[0].replace("\\\n", " ")):
                yield Command(words, where(block.start(2) + line.start()))
    prose = FENCE.sub(lambda block: re.sub(r"[^\n]", " ", block[0]), text)
    for code in re.finditer(r"`(openvima [a-z][^`]*)`", prose):
        for words in openvima_calls(" ".join(code[1].split())):
            yield Command(words, where(code.start()))


def openvima_calls(line: str) -> Iterator[tuple[str, ...]]:
    """Yield the arguments of each call of openvima in one line of shell."""
    if "openvima" not in line:
        return
    line = re.sub(r"\$\(\(.*?\)\)|\$\w+", "1", line)  # the shell's variables and sums: any number will do
    lexer = shlex.shlex(line, posix=True, punctuation_chars="&|;<>")
    lexer.whitespace_split, lexer.commenters = True, "#"
    call: list[str] | None = None
    for word in (*lexer, ";"):
        if set(word) <= set("&|;<>"):
            if call:
                yield tuple(call)
            call = None
        elif call is not None:
            call.append(word)
        elif word.split("/")[-1] == "openvima":
            call = []
        elif word.startswith("openvima "):  # quoted, as the argument of another program
            yield from openvima_calls(word)


@pytest.fixture
def parse(monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Return a function that parses arguments as openvima does and returns what is wrong with them."""

    def ended(function: Callable) -> Callable:
        if isinstance(function, type):  # a config that the command reads, and then works on
            return function

        @functools.wraps(function)
        def end(*_args: object, **_kwargs: object) -> None:
            raise Parsed

        return end

    def cli(function: Callable, **kwargs: object) -> None:
        real_cli(ended(function), **kwargs)
        raise Parsed

    def subcommands(functions: dict[str, Callable], **kwargs: object) -> None:
        real_subcommands({name: ended(function) for name, function in functions.items()}, **kwargs)

    real_cli, real_subcommands = tyro.cli, tyro.extras.subcommand_cli_from_dict
    monkeypatch.setattr(tyro, "cli", cli)
    monkeypatch.setattr(tyro.extras, "subcommand_cli_from_dict", subcommands)
    monkeypatch.setenv("COLUMNS", "200")

    def problem(*words: str) -> str:
        output = io.StringIO()
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            try:
                status = main(words)
            except Parsed:
                return ""
            except SystemExit as end:
                status = end.code
        return output.getvalue() if status else ""

    return problem


@functools.cache
def options() -> dict[tuple[str, ...], frozenset[str]]:
    """Map each verb, with its object if it has some, to the options that its help lists."""
    found = {}
    for verb in VERBS:
        objects = getattr(importlib.import_module(f"openvima.cli.{verb.replace('-', '_')}"), "COMMANDS", {})
        for path in [(verb, name) for name in objects] or [(verb,)]:
            output = io.StringIO()
            with contextlib.redirect_stdout(output), contextlib.suppress(SystemExit):
                main([*path, "--help-all" if verb == "train" else "--help"])
            plain = re.sub(r"\x1b\[[0-9;]*m", "", output.getvalue())
            found[path] = frozenset(
                re.findall(r"(?:^|│ |  )(?:-\w, )?(--[a-z][a-z0-9.-]*)", plain, re.MULTILINE)
            )
            found[path] |= frozenset(re.findall(r", (--no-[a-z0-9.-]+)", plain))
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_the_page_parses(page: Path, parse: Callable[..., str]) -> None:
    problems = []
    for command in commands(page):
        words = [word for word in command.words if word not in ELLIPSES]
        message = parse(*words)
        if re.search(r"[Rr]equired|[Mm]issing", message):  # a fragment; what it does name must exist
            path = next((path for path in options() if path == tuple(words[: len(path)])), None)
            named = {word.split("=")[0] for word in words if OPTION.match(word)}
            message = "" if path and named <= options()[path] else message
        if message:
            problems.append(f"{command}\n{message}")
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_option_named_in_the_text_exists(page: Path) -> None:
    known = benchmark_options().union(*options().values())
    text = page.read_text(encoding="utf-8")
    prose = FENCE.sub(lambda block: "\n" * block[0].count("\n"), text)
    stale = [
        f"{page.relative_to(ROOT)}:{number}: {option}"
        for number, line in enumerate(prose.splitlines(), 1)
        for _, code in re.findall(r"(`+)(.+?)\1", line)
        if code.split()[0] not in OTHER_PROGRAMS
        for option in OPTION.findall(code)
        if option not in known
    ]
    assert not stale, "\n".join(stale)


def benchmark_options() -> frozenset[str]:
    """Return the options that scripts beside the package declare."""
    scripts = [
        path for folder in ("benchmarks", "examples", "experiments/*") for path in ROOT.glob(f"{folder}/*.py")
    ]
    return frozenset(
        option
        for script in scripts
        for option in re.findall(r'add_argument\(\s*"(--[a-z-]+)"', script.read_text(encoding="utf-8"))
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_anchor_and_script_of_the_page_exists(page: Path) -> None:
    missing = []
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        targets = [page.parent / target for target in re.findall(r"\]\((?!\w+:)([^)#\s]+)", line)]
        targets += [
            ROOT / script
            for script in re.findall(r"\b((?:benchmarks|examples|experiments|tests)/[\w/]+\.py)\b", line)
            if script != "benchmarks/NAME.py"
        ]
        missing += [f"{page.relative_to(ROOT)}:{number}: {path}" for path in targets if not path.exists()]
        for target, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)#([^)\s]+)\)", line):
            other = page.parent / target if target else page
            if other.suffix == ".md" and anchor not in anchors(other):
                missing.append(f"{page.relative_to(ROOT)}:{number}: {target}#{anchor}")
    assert not missing, "\n".join(missing)


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives the headings of a page."""
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#+ (.+)$", prose, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def guides() -> list[Path]:
    """Return the pages that docs/README.md lists as guides."""
    text = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    table = text.partition("**Guides**")[2].partition("**Reference**")[0]
    return [ROOT / "docs" / name for name in re.findall(r"\]\((\w+\.md)\)", table)]


def count_words(*pages: Path) -> int:
    """Count what spaces separate, as `wc -w`: code and the bars of tables too."""
    return sum(len(page.read_text(encoding="utf-8").split()) for page in pages)


def test_the_readme_guides_and_all_pages_are_short() -> None:
    assert count_words(ROOT / "README.md") <= 750
    long = {page.name: words for page in guides() if (words := count_words(page)) > 900}
    assert len(guides()) >= 10 and not long
    assert count_words(*(ROOT / "docs").rglob("*.md")) <= 30_000


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_lines_fit_a_screen(page: Path) -> None:
    wide = [
        f"{page.relative_to(ROOT)}:{number}"
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
        if len(line) > 110 and not re.match(r"\s*(\||!\[)", line)  # tables and pictures cannot be wrapped
    ]
    assert not wide, "\n".join(wide)


def test_code_of_the_readme_is_shown_whole() -> None:
    code = [line for block in FENCE.findall(README) for line in block[1].splitlines()]
    assert code and max(map(len, code)) <= 100


def test_a_stale_command_is_reported_with_its_line(parse: Callable[..., str]) -> None:
    assert not parse("evaluate", "--policy", "oracle")
    assert "--polcy" in parse("evaluate", "--polcy", "oracle")
    assert "rotat" in parse("rotat")
    readme = [str(command) for command in commands(ROOT / "README.md")]
    assert any(re.match(r"README\.md:\d+: openvima quickstart --out quickstart$", line) for line in readme)
    assert list(openvima_calls("a | ./openvima tasks > b # c")) == [("tasks",)]
