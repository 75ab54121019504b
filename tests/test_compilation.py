"""Where compiled functions and other derived files are kept."""

import importlib.util
import os
import pwd
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from openvima import compilation
from openvima.input_files import cache_dir

KERNEL = "from openvima.compilation import njit\n\n@njit\ndef double(value):\n    return 2 * value\n"

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")


@pytest.fixture
def homeless(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder for temporary files of a user without a home, without a name and without a cache."""

    def unknown(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    for name in ("HOME", "XDG_CACHE_HOME", "OPENVIMA_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.chdir(tmp_path)
    return folder


@pytest.fixture
def double(tmp_path: Path) -> Callable[[], int]:
    """Compiles and calls a kernel beside which nothing can be written."""
    code = tmp_path / "code"
    code.mkdir()
    (code / "kernel.py").write_text(KERNEL, encoding="utf-8")
    (code / "__pycache__").touch()  # a file, where even root cannot make a folder

    def compile_and_call() -> int:
        compilation._first_writable.cache_clear()
        spec = importlib.util.spec_from_file_location("kernel", code / "kernel.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.double(21)

    return compile_and_call


def indices(folder: Path) -> list[str]:
    return sorted(str(file.relative_to(folder).parts[0]) for file in folder.rglob("*.nbi"))


def test_compiled_functions_go_to_the_cache_of_the_package(homeless, double, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "own"))
    assert double() == 42
    assert indices(tmp_path) == ["own"]


def test_compiled_functions_of_a_user_without_a_home_go_to_temporary_files(homeless, double) -> None:
    assert double() == 42
    (folder,) = homeless.iterdir()
    assert indices(homeless) == [folder.name] and folder.stat().st_mode & 0o777 == 0o700
    assert not Path("~").exists()


def test_a_cache_that_cannot_be_written_is_passed_over(homeless, double, tmp_path, monkeypatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "file"))
    assert double() == 42
    assert indices(tmp_path) == ["temporary"]


@pytest.mark.parametrize("kind", ["writable by others", "link", "file", "nowhere"])
def test_functions_are_not_cached_where_others_write(homeless, double, tmp_path, monkeypatch, kind) -> None:
    folder = cache_dir()
    if kind == "writable by others":
        folder.mkdir()
        folder.chmod(0o777)
    elif kind == "link":
        (tmp_path / "elsewhere").mkdir()
        folder.symlink_to(tmp_path / "elsewhere")
    elif kind == "file":
        folder.touch()
    else:
        monkeypatch.setattr(tempfile, "gettempdir", lambda: (_ for _ in ()).throw(FileNotFoundError()))
    assert double() == 42
    assert indices(tmp_path) == []
