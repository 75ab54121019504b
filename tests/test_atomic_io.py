"""Files appear whole, and a folder has one writer."""

import multiprocessing
import os
import subprocess
import sys
from pathlib import Path

import pytest

from openvima.atomic_io import LOCK_NAME, atomic_folder, folder_lock, remove_stale, restore_folder
from openvima.errors import FolderLockedError
from worker_jobs import holding

KILLED = 9
# Writes a folder and dies at the n-th time that a folder is to be renamed or deleted.
SCRIPT = f"""
import os, shutil, sys
from pathlib import Path
from openvima.atomic_io import atomic_folder

path, left = Path(sys.argv[1]), int(sys.argv[2])

def dying(function):
    def call(*arguments, **options):
        global left
        left -= 1
        if left == 0:
            os._exit({KILLED})
        return function(*arguments, **options)
    return call

with atomic_folder(path) as folder:
    (folder / "a").write_text("new")
    (folder / "b").write_text("new")
    os.replace, shutil.rmtree = dying(os.replace), dying(shutil.rmtree)
"""


def content(folder: Path) -> set[str]:
    return {file.read_text() for file in folder.iterdir()} if folder.exists() else set()


def write(path: Path, text: str) -> None:
    with atomic_folder(path) as folder:
        for name in ("a", "b"):
            (folder / name).write_text(text)


def test_a_folder_appears_and_is_replaced_as_a_whole(tmp_path) -> None:
    path = tmp_path / "made/before/folder"
    write(path, "old")
    assert content(path) == {"old"}
    (path / "c").write_text("old")
    write(path, "new")
    assert content(path) == {"new"}
    assert [each.name for each in path.parent.iterdir()] == ["folder"]


def test_a_failure_leaves_the_old_folder_and_nothing_of_the_new_one(tmp_path) -> None:
    write(tmp_path / "folder", "old")
    with pytest.raises(OSError, match="disk is full"), atomic_folder(tmp_path / "folder") as folder:
        (folder / "a").write_text("new")
        raise OSError("disk is full")
    assert content(tmp_path / "folder") == {"old"}
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


@pytest.mark.parametrize("step", [1, 2, 3, 4, 5])
def test_a_process_that_dies_loses_neither_the_old_nor_half_of_the_new(tmp_path, step: int) -> None:
    write(tmp_path / "folder", "old")
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "folder"), str(step)]
    assert subprocess.run(command, check=False).returncode in (KILLED, 0)
    restore_folder(tmp_path / "folder")
    assert content(tmp_path / "folder") == ({"old"} if step < 4 else {"new"})
    write(tmp_path / "folder", "again")
    assert content(tmp_path / "folder") == {"again"}


@pytest.mark.skipif(os.name != "posix", reason="only POSIX tells which processes run")
def test_files_of_processes_that_still_run_are_not_abandoned(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    names = [f".a.arrow.{os.getpid()}.tmp", f".b.arrow.{gone.pid}.tmp", ".c.tmp", f".d.{10**30}.tmp"]
    for name in names:
        (tmp_path / name).touch()
    remove_stale(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {names[0], names[2]}


@pytest.mark.skipif(os.name != "posix", reason="only POSIX tells which processes run")
def test_a_folder_that_a_killed_writer_began_goes_with_the_next(tmp_path: Path) -> None:
    (tmp_path / f".folder.{10**30}.tmp").mkdir()
    (tmp_path / f".other.{10**30}.tmp").mkdir()
    write(tmp_path / "folder", "new")
    assert {path.name for path in tmp_path.iterdir()} == {"folder", f".other.{10**30}.tmp"}


def test_nothing_of_a_lock_stays(tmp_path) -> None:
    with folder_lock(tmp_path / "made"):
        assert (tmp_path / "made" / LOCK_NAME).is_file()
    assert not (tmp_path / "made").exists()
    with folder_lock(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_second_writer_is_refused_by_name_until_the_first_ends(tmp_path) -> None:
    with holding(tmp_path) as process:
        with pytest.raises(FolderLockedError, match=f"written to by process {process.pid}") as e:
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


def test_a_link_as_lock_file_is_not_followed(tmp_path) -> None:
    (tmp_path / LOCK_NAME).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="symbolic links"):
        folder_lock(tmp_path).__enter__()
    assert not (tmp_path / "elsewhere").exists()
