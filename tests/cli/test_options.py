"""Options and streams of commands."""

import contextlib
import io
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.table import Table

from openvima.cli.main import VERBS, main
from openvima.cli.options import name_options
from openvima.cli.terminal import plain_lines, print_table
from openvima.cli.train import COMMON
from openvima.data import Dataset, Shard


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
    assert re.search(r"--schedule\.steps INT [^-]*\(default:\s*16000\)", shown)


def test_help_of_evaluation_is_grouped(capsys) -> None:
    shown = help_of(capsys, "evaluate", "--help")
    first, *groups = re.split(r"^ [a-z]+ options *$", shown, flags=re.MULTILINE)
    assert options_of(first) >= {"--policy", "--tasks", "--out"} and len(options_of(first)) < 10
    assert len(groups) == 7 and any("--ablations" in group and "--boxes" in group for group in groups)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train --loader.batch-size 0", "--loader.batch-size is 0; it must be at least 1."),
        ("train --seed -1", "--seed is -1; it must be between"),
        ("train --preset vima-2m", "set --t5 to the folder .* or set --model.text-encoder to 'small'"),
        ("train --t5 folder", "leave --t5 out, or set --model.text-encoder to a T5"),
        ("train --loader.detected-prob 0.5", "--loader.detected-prob is 0.5, .* with --loader.boxes"),
        ("train --preset vima", "Did you mean 'vima-nano'?"),
        ("train --preset GPT", "Did you mean 'gpt-nano'?"),
        ("train --preset vima-200", "Did you mean 'vima-200m'?"),
        ("evaluate --policy vima", "Did you mean 'openvima-vima'?"),
        ("evaluate --policy random --shard-range 3", "--shard-range is '3'"),
        ("evaluate --policy random --videos -1", "--videos is -1"),
        ("evaluate --policy random --tasks rotate --task-options x", "task option 'x' is not"),
        ("generate --tasks rotate --workers 0 --episodes 1", "--workers is 0"),
        ("detector train --loader.batch-size 3", "--loader.batch-size is 3; it must be even"),
    ],
)
def test_errors_name_the_options_that_users_type(words, message, tmp_path, capsys) -> None:
    given = words.split()
    paths = ["--out", str(tmp_path / "out")] + ["--data", str(tmp_path)] * ("train" in given)
    assert main([*given, *paths]) == 2
    shown = capsys.readouterr().err
    assert shown.count("\n") == 1 and re.search(message, shown), shown


def test_what_users_gave_and_python_keep_their_names() -> None:
    settings = ["data", "t5", "object_cache", "loader.batch_size"]
    message = (
        "there is no folder 'object_cache' in runs/object_cache, with data as t5-base has: f(object_cache=1)."
    )
    assert name_options(message, settings) == message
    assert name_options("lower loader.batch_size.", settings) == "lower --loader.batch-size."


@pytest.mark.parametrize("verb", ["evaluate --policy oracle --levels L1", "generate --out demos"])
def test_tasks_without_a_text_form_are_named_where_all_tasks_leave_them_out(verb, capsys) -> None:
    words = [*verb.split(), "--episodes", "1", "--list-shards", "--tasks"]
    assert main([*words, "all", "--prompts", "text"]) == 0
    played, said = capsys.readouterr()
    assert "no text form: follow_order, rearrange, " in said and "rearrange" not in played
    assert main([*words, "all"]) == main([*words, "rotate", "--prompts", "text"]) == 0
    assert not capsys.readouterr().err


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


WORDS = ["generate", "--tasks", "rotate", "--episodes", "5"]


def test_flags_reach_the_shards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--compression", "zstd", "--no-images", "--keep-failed", "--seed", "7", "--shard-size", "3"]
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


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--shard-range", "3"], "--shard-range is '3'; it must be a:b"),
        (["--shard-range", "9:10"], "--shard-range is 9:10, but shards are numbered from 0 to 1"),
        (["--shard-range", "0:1", "--force"], "exclude each other"),
        (["--address", "head:6379"], "only 'ray' takes one"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(
    flags: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*WORDS, *flags, "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err.strip()
    assert message in line
    assert "\n" not in line
    assert not (tmp_path / "out").exists()


def test_without_a_terminal_progress_is_a_line_at_each_stage_and_each_minute(
    capsys: pytest.CaptureFixture[str],
) -> None:
    now = 0.0
    report = plain_lines("training", clock=lambda: now)
    for step in range(401):
        now = float(step)
        stage = "pretraining" if step < 150 else "cloning"
        report(step, 400, f"{stage}: loss {step}")
    lines = capsys.readouterr().err.splitlines()
    assert [int(line.split()[1]) for line in lines] == [0, 60, 120, 150, 210, 270, 330, 390, 400]
    assert lines[1] == "training: 60 of 400 (15 %), 1.0/s, 0:05:40 left; pretraining: loss 60"
    assert lines[3] == "training: 150 of 400 (37 %); cloning: loss 150"
    assert lines[-1] == "training: 400 of 400 (100 %), 1.0/s; cloning: loss 400"
