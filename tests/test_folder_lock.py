"""A folder has one writer at a time, or one for each of its parts, and a killed writer locks nobody out."""

import json
import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from openvima import atomic_io as module
from openvima.atomic_io import LOCK_NAME, folder_lock
from openvima.errors import FolderLockedError, StorageError
from worker_jobs import holding


def write_owner(folder: Path, host: str, process: int, **changes: object) -> Path:
    entry = {"host": host, "process": process, "command": "openvima train", "since": 0.0, "part": [0, 9]}
    file = folder / f"{LOCK_NAME}.{host}.{process}"
    file.write_text(json.dumps(entry | changes))
    return file


def test_nothing_of_a_lock_stays(tmp_path) -> None:
    with folder_lock(tmp_path / "made"):
        assert (tmp_path / "made" / LOCK_NAME).is_file()
    assert not (tmp_path / "made").exists()
    with folder_lock(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_second_writer_is_refused_by_name_until_the_first_ends(tmp_path) -> None:
    with holding(tmp_path) as process:
        with pytest.raises(FolderLockedError, match=rf"written to by process {process.pid} on .* 0 min") as e:
            folder_lock(tmp_path).__enter__()
        assert "\n" not in str(e.value)
        assert process.stdin is not None
        process.stdin.close()
        with folder_lock(tmp_path, timeout_s=10):
            pass
    assert not list(tmp_path.iterdir())


def test_the_lock_of_a_killed_writer_is_free_and_its_files_go(tmp_path) -> None:
    with holding(tmp_path) as process:
        process.kill()
        process.wait()
    (tmp_path / f".dataset.json.{process.pid}.tmp").write_text("half")
    (tmp_path / f".checkpoint.{process.pid}.tmp").mkdir()
    assert (tmp_path / LOCK_NAME).exists()
    with folder_lock(tmp_path):
        assert sorted(path.name for path in tmp_path.iterdir())[0] == LOCK_NAME
        assert not list(tmp_path.glob("*.tmp"))
    assert not list(tmp_path.iterdir())


def test_disjoint_parts_have_a_writer_each_and_exclude_one_of_the_whole(tmp_path) -> None:
    with holding(tmp_path, 0, 3) as first:
        with folder_lock(tmp_path, (3, 5)):
            pass
        for part in ((2, 4), None):
            with pytest.raises(FolderLockedError, match=f"process {first.pid}"):
                folder_lock(tmp_path, part).__enter__()
    with folder_lock(tmp_path):
        pass


def test_threads_of_one_process_exclude_each_other(tmp_path) -> None:
    with folder_lock(tmp_path):
        with pytest.raises(FolderLockedError, match="another thread of this process"):
            folder_lock(tmp_path).__enter__()
        with pytest.raises(FolderLockedError):
            folder_lock(tmp_path / ".." / tmp_path.name).__enter__()


def test_a_forked_child_neither_keeps_nor_releases_the_lock(tmp_path) -> None:
    context = multiprocessing.get_context("fork")
    go_on = context.Event()
    with folder_lock(tmp_path):
        child = context.Process(target=go_on.wait, args=(10,))
        child.start()
    with folder_lock(tmp_path):
        pass
    go_on.set()
    child.join()


def test_an_owner_on_another_host_counts_as_long_as_it_touches_its_file(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(module, "HEARTBEAT_S", 0.2)  # on a busy machine a thread may wait for 0.1 s
    file, stop = write_owner(tmp_path, "elsewhere", 7), threading.Event()

    def beat() -> None:
        while not stop.wait(0.005):
            os.utime(file)

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        with pytest.raises(FolderLockedError, match="process 7 on elsewhere"):
            folder_lock(tmp_path).__enter__()
    finally:
        stop.set()
        thread.join()
    with folder_lock(tmp_path):
        assert not file.exists()


@pytest.mark.parametrize("runs", [True, False])
def test_without_record_locks_the_process_decides(tmp_path, monkeypatch, runs: bool) -> None:
    monkeypatch.setattr(module, "fcntl", None)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    write_owner(tmp_path, module._host(), os.getppid() if runs else gone.pid)
    if runs:
        with pytest.raises(FolderLockedError, match=f"process {os.getppid()}"):
            folder_lock(tmp_path).__enter__()
        return
    with folder_lock(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


OWNER = '{"host": "elsewhere", "process": 1, "command": "x", "since": 0.0, "part": [0, 9]}'


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{",
        '{"host": 1}',
        "x" * 10_000,
        "[" * 4000,
        OWNER.replace('"elsewhere"', "[1]"),
        OWNER.replace("1,", "1e999,"),
        OWNER.replace("0.0", "NaN"),
        OWNER.replace("0.0", "1e999"),
        OWNER.replace("[0, 9]", "[]"),
        OWNER.replace("[0, 9]", "[1e999, 9]"),
    ],
)
def test_whatever_an_owner_s_file_holds_locks_nobody_out(tmp_path, content: str) -> None:
    (tmp_path / f"{LOCK_NAME}.elsewhere.1").write_text(content)
    with folder_lock(tmp_path):
        pass


def test_names_in_the_message_hold_no_control_characters(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(module, "fcntl", None)
    command = "train\x1b[2J\n" + "x" * 500
    write_owner(tmp_path, module._host(), os.getppid(), command=command)
    with pytest.raises(FolderLockedError) as found:
        folder_lock(tmp_path).__enter__()
    assert str(found.value).isprintable()
    assert len(str(found.value)) < 500


def test_a_link_folder_or_pipe_as_lock_file_is_refused(tmp_path) -> None:
    target = tmp_path / "elsewhere"
    for name, make in (("a", lambda p: p.symlink_to(target)), ("b", Path.mkdir), ("c", os.mkfifo)):
        (tmp_path / name).mkdir()
        make(tmp_path / name / LOCK_NAME)
        with pytest.raises(StorageError, match="no regular file"):
            folder_lock(tmp_path / name).__enter__()
    assert not target.exists()


def test_one_of_many_processes_gets_in_at_a_time(tmp_path) -> None:
    script = (
        "import sys, time; from pathlib import Path; from openvima.atomic_io import folder_lock\n"
        "for _ in range(10):\n"
        "    with folder_lock(Path(sys.argv[1]), timeout_s=30):\n"
        "        file = Path(sys.argv[1]) / 'inside'\n"
        "        file.open('x').close(); file.unlink()\n"
    )
    folder = tmp_path / "folder"
    workers = [subprocess.Popen([sys.executable, "-c", script, str(folder)]) for _ in range(2)]
    assert [worker.wait(60) for worker in workers] == [0, 0]
    assert not list(folder.glob("*"))
