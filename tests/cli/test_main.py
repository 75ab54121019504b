"""The program's frame: overview, unknown verbs, exit codes."""

from pathlib import Path

import pytest

from openvima import __version__
from openvima.cli.main import VERBS, main


def test_help_lists_every_verb_and_a_first_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {verb} " in shown for verb in VERBS)
    assert "openvima quickstart --out" in shown


def test_no_arguments_is_wrong_usage() -> None:
    assert main([]) == 2


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == __version__


def test_a_mistyped_verb_gets_a_suggestion_and_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluat"]) == 2
    assert "Did you mean 'evaluate'?" in capsys.readouterr().err


@pytest.mark.parametrize("verb", list(VERBS))
def test_every_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([verb, "--help"])
    assert stopped.value.code == 0
    assert f"openvima {verb}" in capsys.readouterr().out


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb not in ("assets", "data")])
def test_a_wrong_option_is_wrong_usage(verb: str) -> None:
    with pytest.raises(SystemExit) as stopped:
        main([verb, "--no-such-option", "1"])
    assert stopped.value.code == 2


def test_an_error_about_input_is_one_line_and_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "rotat", "--out", "never_written.mp4"]) == 2
    message = capsys.readouterr().err.strip()
    assert "Did you mean 'rotate'?" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    "words",
    [
        ["generate", "--tasks", "rotate", "--episodes", "1", "--out"],
        ["evaluate", "--policy", "oracle", "--tasks", "rotate", "--levels", "L1", "--no-report", "--out"],
    ],
    ids=lambda words: words[0],
)
def test_a_path_that_cannot_be_used_is_one_line_and_status_2(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.touch()
    assert main([*words, str(file)]) == 2
    message = capsys.readouterr().err.strip()
    assert f"cannot use {file}" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    "words",
    [
        ["demo", "rotate", "--out", "video.gif"],
        ["report", "evaluation", "--out", "report.pdf"],
        ["quickstart", "--demonstrations", "0"],
        ["quickstart", "--workers", "0"],
        ["evaluate", "--policy", "mine="],
        ["evaluate", "--policy", "oracle", "--seed", str(2**63 - 1)],
    ],
)
def test_wrong_input_is_refused_before_any_work(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert "\n" not in capsys.readouterr().err.strip()
    assert not list(tmp_path.iterdir())
