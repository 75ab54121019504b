"""The program's frame: overview, unknown verbs, exit codes."""

import errno
import importlib
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from openvima import __version__
from openvima.cli.main import VERBS, main
from openvima.errors import ConfigError, DatasetError
from openvima.policies.tokenizer import WordTokenizer


def fail_with(error: Exception) -> Callable[[Sequence[str]], int]:
    """Return a verb that fails."""

    def run(words: Sequence[str]) -> int:
        raise error

    return run


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


def test_words_that_a_policy_never_saw_are_one_line_and_the_verb_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tokenizer = WordTokenizer()

    def run(words: Sequence[str]) -> int:
        tokenizer.encode("put the \x1b[2J quokka")
        return 0

    monkeypatch.setattr(importlib, "import_module", lambda name: SimpleNamespace(run=run))
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(["tasks"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("openvima: UnknownWordWarning: ") and "'quokka'" in line and line.isprintable()


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device"),
            "cannot write here: No space left on device. F",
        ),
        (OSError(errno.EDQUOT, "Disk quota exceeded", "a/b"), "cannot write a/b: Disk quota exceeded. Free"),
        (MemoryError("Unable to allocate 9 GiB"), "out of memory while working on here; lower the size"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "out of memory while working on here"),
        (RuntimeError("CUDA out of memory."), "out of memory while working on here"),
        (ValueError("Error: engine error: Could not allocate memory"), "out of memory while working on here"),
        (ImportError("x.so: failed to map segment from shared object"), "out of memory while working on"),
        (DatasetError("a.arrow: Memory mapping file failed: Cannot allocate memory"), "out of memory while"),
    ],
    ids=["disk", "quota", "memory", "torch", "cuda", "mujoco", "library", "arrow"],
)
def test_a_full_disk_or_memory_is_one_line_with_path_and_remedy(
    error: Exception, message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    verb = SimpleNamespace(run=fail_with(error))
    monkeypatch.setattr(importlib, "import_module", lambda name: verb)
    assert main(["generate", "--out", "here"]) == 1
    shown = capsys.readouterr().err.strip()
    assert message in shown
    assert "\n" not in shown


@pytest.mark.parametrize(("verb", "last"), [("serve", "goodbye."), ("train", "resumes."), ("tasks", "ed.")])
def test_an_interrupted_verb_says_what_that_means(
    verb: str, last: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = SimpleNamespace(run=fail_with(KeyboardInterrupt()))
    monkeypatch.setattr(importlib, "import_module", lambda name: module)
    assert main([verb]) == 130
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith(last)


def test_what_a_message_quotes_cannot_steer_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fail = fail_with(ConfigError("\x1b[2J\nname" + 10_000 * "x"))
    verb = SimpleNamespace(run=fail)
    monkeypatch.setattr(importlib, "import_module", lambda name: verb)
    assert main(["generate"]) == 2
    shown = capsys.readouterr().err.strip()
    assert shown.isprintable()
    assert len(shown) < 5000
