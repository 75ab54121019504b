"""Files and folders are whole under their name, whatever happens while they are written."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from openvima.atomic_io import atomic_folder, remove_stale, restore_folder

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


def test_a_folder_appears_with_everything_in_it_and_nothing_beside_it(tmp_path) -> None:
    write(tmp_path / "made/before/folder", "new")
    assert content(tmp_path / "made/before/folder") == {"new"}
    assert [path.name for path in (tmp_path / "made/before").iterdir()] == ["folder"]


def test_a_folder_is_replaced_as_a_whole(tmp_path) -> None:
    write(tmp_path / "folder", "old")
    (tmp_path / "folder" / "c").write_text("old")
    write(tmp_path / "folder", "new")
    assert content(tmp_path / "folder") == {"new"}
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


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
