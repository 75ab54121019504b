"""Functions of users by name."""

import subprocess
import sys
from pathlib import Path

import pytest

from openvima import user_code
from openvima.errors import ConfigError
from openvima.user_code import (
    call_function,
    load_function,
    source_hash,
    without_folder,
)

CODE = "import beside_it\n\ndef make(size=3):\n    return beside_it.NAME, size\n\nnumber = 4\n"


@pytest.fixture(autouse=True)
def _restored(monkeypatch):
    """Leave the search path and the loaded modules as they were."""
    # Without folders that other tests loaded a file of the same name from.
    monkeypatch.setattr(sys, "path", [path for path in sys.path if not Path(path, "mine.py").exists()])
    monkeypatch.setattr(user_code, "_loaded", {})
    for name in ("mine", "beside_it"):  # of files that other tests loaded
        monkeypatch.delitem(sys.modules, name, raising=False)
    before = dict(sys.modules)
    yield
    for name in set(sys.modules) - set(before):
        if name.startswith(("openvima_user_", "mine", "beside_it")):
            del sys.modules[name]


@pytest.fixture
def file(tmp_path):
    folder = tmp_path / "my files"
    folder.mkdir()
    (folder / "beside_it.py").write_text("NAME = 'beside'\n")
    (folder / "mine.py").write_text(CODE)
    return folder / "mine.py"


def test_a_function_is_found_in_a_file_by_relative_and_absolute_path(file, monkeypatch):
    assert call_function(f"{file}:make", what="policy") == ("beside", 3)
    monkeypatch.chdir(file.parent)
    assert load_function("mine.py:make", what="policy") is load_function(f"{file}:make", what="policy")
    assert user_code.with_absolute_path("mine.py:make") == f"{file}:make"
    assert without_folder(f"{file}:make") == "mine.py:make"
    assert call_function("collections:OrderedDict", what="policy") == {}
    assert user_code.with_absolute_path("collections:OrderedDict") == "collections:OrderedDict"


def test_a_changed_file_is_run_again_and_has_another_digest(file):
    digest = source_hash(f"{file}:make", what="policy")
    assert source_hash(f"{file}:make", what="policy") == digest
    file.write_text(CODE.replace("size=3", "size=5"))
    assert call_function(f"{file}:make", what="policy") == ("beside", 5)
    assert source_hash(f"{file}:make", what="policy") != digest
    assert len(source_hash("collections:OrderedDict", what="policy")) == 64
    assert len(source_hash("math:floor", what="policy")) == 64  # built in: it has no file


def test_files_of_the_same_name_and_names_of_libraries_do_not_collide(file, tmp_path):
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "mine.py").write_text(f"def make():\n    return {number}\n")
        (folder / "random.py").write_text(f"def make():\n    return -{number}\n")
    found = [call_function(f"{tmp_path / n / f}.py:make", what="x") for n in "12" for f in ("mine", "random")]
    assert found == [1, -1, 2, -2]
    assert "make" not in vars(sys.modules.get("random", sys))


def test_spawned_processes_can_import_what_a_file_defines(file):
    function = load_function(f"{file}:make", what="policy")
    assert function.__module__ == "mine"
    path = f"import sys; sys.path = {sys.path!r}; from mine import make; assert make()"
    subprocess.run([sys.executable, "-c", path], check=True)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("mine", "name a function as MODULE:FUNCTION or FILE.py:FUNCTION"),
        ("none.py:make", "policy names 'none.py', and there is no such Python file"),
        ("folder.py:make", "policy names 'folder.py', and there is no such Python file"),
        ("no_such:make", "no such module; set PYTHONPATH"),
        ("mine:make", "no such module; name it as mine.py:FUNCTION"),
        ("mine.py:other", "mine.py has no function 'other'"),
        ("mine.py:number", "which is a int; name a function"),
        ("bad.py:make", r"which raised KeyError: 'a' \(bad.py, line 2\)\.$"),
        ("syntax.py:make", r"which raised SyntaxError: .*syntax.py, line 1"),
        ("leaves.py:make", "which raised SystemExit: 3"),
        ("missing.py:make", r"ModuleNotFoundError: No module named 'no_such' \(missing.py, line 1\)"),
        ("functions.py:needy", r"missing 1 required positional argument: 'run'"),
        ("functions.py:fails", r"raised ZeroDivisionError: division by zero \(functions.py, line 5\)\.$"),
    ],
)
def test_what_cannot_be_loaded_is_named_in_one_line(source, message, file, monkeypatch):
    monkeypatch.chdir(file.parent)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])  # as in the console script
    (file.parent / "folder.py").mkdir()
    for name, code in {
        "bad": "values = {}\nvalues['a']",
        "syntax": "def",
        "leaves": "import sys\nsys.exit(3)",
        "missing": "import no_such",
        "functions": "def needy(run):\n    pass\n\ndef fails():\n    return 1 / 0",
    }.items():
        (file.parent / f"{name}.py").write_text(code)
    modules = set(sys.modules)
    with pytest.raises(ConfigError, match=message) as caught:
        call_function(source, what="policy")
    assert "\n" not in str(caught.value)
    assert not {"bad", "syntax", "leaves", "missing"} & (set(sys.modules) - modules)
