"""A folder has one writer at a time, or one for each of its parts, and a killed writer locks nobody out."""

import multiprocessing

import pytest

from openvima.atomic_io import LOCK_NAME, folder_lock
from openvima.errors import FolderLockedError
from worker_jobs import holding


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


def test_a_link_as_lock_file_is_not_followed(tmp_path) -> None:
    (tmp_path / LOCK_NAME).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="symbolic links"):
        folder_lock(tmp_path).__enter__()
    assert not (tmp_path / "elsewhere").exists()
