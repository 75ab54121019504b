"""The program: verbs, options, streams and exit codes."""

import contextlib
import errno
import importlib
import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.table import Table

from openvima import __version__
from openvima.cli import terminal
from openvima.cli.main import VERBS, main
from openvima.cli.train import COMMON
from openvima.data import Dataset, Shard
from openvima.errors import ConfigError, DatasetError
from openvima.policies.tokenizer import WordTokenizer


def help_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 0
    return capsys.readouterr().out


def options_of(shown: str) -> set[str]:
    return set(re.findall(r"^ {2}(--\w[\w.-]+)", shown, re.MULTILINE))


def test_help_of_training_shows_what_most_runs_set_and_help_all_the_rest(capsys) -> None:
    common = options_of(help_of(capsys, "train", "--help"))
    assert common == {"--" + name.replace("_", "-") for name in COMMON} and len(common) <= 16
    every = options_of(help_of(capsys, "train", "--help-all"))
    assert common < every and "--augmentation.synonym-prob" in every - common


def test_help_of_training_tells_the_defaults_of_the_recipe(capsys) -> None:
    shown = help_of(capsys, "train", "--preset", "vima-nano", "--help")
    assert re.search(r"--schedule\.steps INT [^-]*\(default:\s*12000\)", shown)


def test_help_of_evaluation_is_grouped(capsys) -> None:
    shown = help_of(capsys, "evaluate", "--help")
    first, *groups = re.split(r"^ [a-z]+ options *$", shown, flags=re.MULTILINE)
    assert options_of(first) >= {"--policy", "--tasks", "--out"} and len(options_of(first)) < 10
    assert len(groups) == 7 and any("--ablations" in group and "--boxes" in group for group in groups)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("demo", "either a TASK or --episode FILE"),
        ("demo rotate --out video.gif", "video.gif"),
        ("demo rotate --episode x.yaml", "either a TASK or --episode FILE"),
        ("demo --episode missing.yaml", r"missing\.yaml"),
        ("demo --episode x.yaml --seed 3", "leave these and --control out"),
        ("quickstart --demonstrations 0", "demonstrations is 0"),
        ("report evaluation --out report.pdf", r"\.md or \.tex"),
        ("serve randm", r"there is no policy 'randm'\. Did you mean 'random'"),
        ("serve random --host 0.0.0.0", "give a token"),
        ("serve random --port 70000", "port must be 0-65535"),
        ("train --loader.batch-size 0", "loader.batch_size is 0; it must be at least 1."),
        ("train --seed -1", "seed is -1; it must be between"),
        ("train --preset vima-2m", "set t5 to the folder .* or set model.text_encoder to 'small'"),
        ("train --t5 folder", "leave t5 out, or set model.text_encoder to a T5"),
        ("train --loader.detected-prob 0.5", "loader.detected_prob is 0.5, .* with loader.boxes"),
        ("evaluate --policy vima", "Did you mean 'openvima-vima'?"),
        ("evaluate --policy mine=", "got mine; name them as NAME=PATH"),
        ("evaluate --policy oracle,vima-nano", "untrained:vima-nano has random ones"),
        (
            "evaluate --policy oracle --tasks sweep_without_exceeding --levels L3",
            "nothing to play: sweep_without_exceeding at L3",
        ),
        (f"evaluate --policy oracle --seed {2**63 - 1}", "seed is"),
        ("evaluate --policy random --shard-range 3", "shard_range is '3'"),
        ("evaluate --policy random --videos -1", "videos is -1"),
        ("generate --tasks rotate --workers 0 --episodes 1", "workers is 0"),
        ("generate --tasks rotate --episodes 5 --shard-range 9:10", "shards are numbered from 0 to 1"),
        ("generate --tasks rotate --shard-range 0:1 --force", "exclude each other"),
        ("generate --tasks rotate --address head:6379", "only 'ray' takes one"),
        ("detector train --loader.batch-size 3", "loader.batch_size is 3; it must be even"),
    ],
)
def test_wrong_input_is_one_line(words, message, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    given = words.split() + ["--data", "."] * ("train" in words)
    paths = ["--out", "out.mp4" if given[0] == "demo" else "out"]
    assert main([*given, *paths * ("--out" not in given and given[0] != "serve")]) == 2
    shown = capsys.readouterr().err
    assert shown.count("\n") == 1 and re.search(message, shown), shown
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("verb", ["evaluate --policy oracle --levels L1", "generate --out demos"])
def test_tasks_without_a_text_form_are_named_where_all_tasks_leave_them_out(verb, capsys) -> None:
    words = [*verb.split(), "--episodes", "1", "--list-shards", "--tasks"]
    assert main([*words, "all", "--prompts", "text"]) == 0
    played, said = capsys.readouterr()
    assert "no text form: follow_order, rearrange, " in said and "rearrange" not in played
    assert main([*words, "all"]) == main([*words, "rotate", "--prompts", "text"]) == 0
    assert not capsys.readouterr().err


def test_levels_that_hold_none_of_the_tasks_are_named(capsys) -> None:
    words = "evaluate --policy oracle --list-shards --episodes 1 --levels L1,L3,L4 --tasks"
    assert main([*words.split(), "sweep_without_exceeding"]) == main([*words.split(), "all"]) == 0
    played, said = capsys.readouterr()
    assert said == "Left out, since they hold none of the tasks: L3, L4.\n" and "rotate\tL3" in played


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
    assert words[-1] != "--help" or f"openvima {words[0]}" in text
    assert words != ["tasks"] or max(map(len, text.splitlines())) <= 60


def test_a_table_that_is_too_wide_becomes_a_paragraph_for_each_row(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = Table("level", "task", title="rates")
    for policy in ("first", "second"):
        table.add_column(policy, no_wrap=True)
    table.add_row("L1", "rotate", "100.0 (51–100)", "0.0 (0–49)")
    monkeypatch.setenv("COLUMNS", "30")
    terminal.print_table(table, num_heads=2)
    assert [line.rstrip() for line in capsys.readouterr().out.splitlines()] == [
        "rates",
        "L1 rotate",
        "  first: 100.0 (51–100)",
        "  second: 0.0 (0–49)",
    ]
    monkeypatch.setenv("COLUMNS", "60")
    terminal.print_table(table, num_heads=2)
    assert "│ L1    │ rotate │ 100.0 (51–100) │" in capsys.readouterr().out


WORDS = ["generate", "--tasks", "rotate", "--episodes", "5"]


def test_flags_reach_the_shards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--compression", "zstd", "--no-images", "--seed", "7", "--shard-size", "3"]
    assert main([*WORDS, *flags, "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'out'}\n"
    shard = Shard(tmp_path / "out" / "rotate-train-00001.arrow")
    assert (shard.info.compression, shard.info.images) == ("zstd", False)
    assert (shard.info.first_seed, shard.info.shard_size, len(shard)) == (7, 3, 2)


def test_parts_of_a_job_array_tell_whether_the_data_set_is_finished(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert main([*WORDS, "--list-shards", *out]) == 0
    assert capsys.readouterr().out == "0\trotate-train-00000.arrow\t4\n1\trotate-train-00001.arrow\t1\n"
    assert not (tmp_path / "out").exists()
    assert main([*WORDS, "--shard-range", "1:2", *out]) == 0
    assert "is not finished yet" in capsys.readouterr().err
    assert main([*WORDS, "--shard-range", "0:1", *out]) == 0
    assert "shows what is there" in capsys.readouterr().err
    assert len(Dataset(tmp_path / "out")) == 5


def test_without_a_terminal_progress_is_a_line_each_minute_and_at_the_end(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(terminal, "time", SimpleNamespace(monotonic=lambda: now))
    report = terminal.plain_lines("training")
    for step in range(401):
        now = float(step)
        stage = "pretraining" if step < 150 else "cloning"
        report(step, 400, f"{stage}: loss {step}")
    report(400, 400, "once more")
    lines = capsys.readouterr().err.splitlines()
    assert [int(line.split()[1]) for line in lines] == [0, 60, 120, 180, 240, 300, 360, 400]
    assert lines[1] == "training: 60 of 400, 0:05:40 left; pretraining: loss 60"
    assert lines[-1] == "training: 400 of 400, 0:00:00 left; cloning: loss 400"


def fail_with(error: Exception) -> Callable[[Sequence[str]], int]:
    """Return a verb that fails."""

    def run(words: Sequence[str]) -> int:
        raise error

    return run


def test_help_version_and_what_is_no_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {verb} " in shown for verb in VERBS)
    assert "openvima quickstart --out" in shown
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == __version__
    assert main([]) == main(["evaluat"]) == 2
    assert "Did you mean 'evaluate'?" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stopped:
        main(["tasks", "--no-such-option", "1"])
    assert stopped.value.code == 2


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
            "cannot write a file: No space left on device. F",
        ),
        (OSError(errno.EDQUOT, "Disk quota exceeded", "a/b"), "cannot write a/b: Disk quota exceeded. Free"),
        (MemoryError("Unable to allocate 9 GiB"), "out of memory; lower the size"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), "out of memory; lower"),
        (RuntimeError("CUDA out of memory."), "out of memory; lower"),
        (ValueError("Error: engine error: Could not allocate memory"), "out of memory; lower"),
        (ImportError("x.so: failed to map segment from shared object"), "out of memory; lower"),
        (DatasetError("a.arrow: Memory mapping file failed: Cannot allocate memory"), "out of memory; lower"),
    ],
    ids=["disk", "quota", "memory", "torch", "cuda", "mujoco", "library", "arrow"],
)
def test_a_full_disk_or_memory_is_one_line_with_a_remedy(
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
