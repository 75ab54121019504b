"""Output reaches streams of any encoding, and narrow terminals."""

import contextlib
import io
from collections.abc import Iterator

import pytest
from rich.table import Table

from openvima.cli.main import VERBS, main
from openvima.cli.terminal import accept_any_text, print_table


@contextlib.contextmanager
def ascii_stdout() -> Iterator[io.BytesIO]:
    """Replace stdout by a stream that takes ASCII only."""
    content = io.BytesIO()
    with contextlib.redirect_stdout(io.TextIOWrapper(content, encoding="ascii", write_through=True)) as held:
        yield content
    held.detach()


@pytest.mark.parametrize(
    "words",
    [*([verb, "--help"] for verb in VERBS), ["tasks"], ["assets", "info"]],
    ids=" ".join,
)
def test_every_help_and_list_can_be_written_in_ascii(
    words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    with ascii_stdout() as written:
        try:
            assert main(words) == 0
        except SystemExit as ended:
            assert ended.code == 0
        text = written.getvalue().decode("ascii")
    assert "?" not in text
    assert words != ["tasks"] or max(map(len, text.splitlines())) <= 60


def test_letters_become_similar_ascii() -> None:
    with ascii_stdout() as written:
        accept_any_text()
        print("3 × 4 – 5 · 45° ≈ é 漢 ┏━┳┓ │ \udcff")
        assert written.getvalue() == b"3 x 4 - 5 . 45 deg ~ e ? +-++ | \xff\n"


def test_a_table_that_is_too_wide_becomes_a_paragraph_for_each_row(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = Table("level", "task", title="rates")
    for policy in ("first", "second"):
        table.add_column(policy, no_wrap=True)
    table.add_row("L1", "rotate", "100.0 (51–100)", "0.0 (0–49)")
    monkeypatch.setenv("COLUMNS", "30")
    print_table(table, num_heads=2)
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == [
        "rates",
        "L1 rotate",
        "  first: 100.0 (51–100)",
        "  second: 0.0 (0–49)",
    ]
    monkeypatch.setenv("COLUMNS", "60")
    print_table(table, num_heads=2)
    assert "│ L1    │ rotate │ 100.0 (51–100) │" in capsys.readouterr().out
