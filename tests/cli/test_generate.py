"""`openvima generate`: flags reach the library, and progress fits where it is shown."""

from pathlib import Path

import pytest

from openvima.cli.main import main
from openvima.cli.terminal import plain_lines
from openvima.data import Dataset, Shard

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
