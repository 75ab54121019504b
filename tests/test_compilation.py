"""Where compiled functions are kept."""

import importlib.util
import os

import pytest
from numba.core import config

KERNEL = "from openvima.compilation import njit\n\n@njit\ndef double(value):\n    return 2 * value\n"

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")


@pytest.mark.parametrize("place", ["named", "beside", "nowhere"])
def test_compiled_functions_are_kept_where_a_folder_can_be_written(place, tmp_path, monkeypatch) -> None:
    code = tmp_path / "code"
    code.mkdir()
    (code / "kernel.py").write_text(KERNEL, encoding="utf-8")
    (tmp_path / "file").touch()
    if place == "nowhere":
        (code / "__pycache__").touch()  # a file, where even root cannot make a folder
    monkeypatch.setenv("HOME", str(tmp_path / "file"))
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "named") if place == "named" else "")
    spec = importlib.util.spec_from_file_location("kernel", code / "kernel.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.double(21) == 42
    indices = [file.relative_to(tmp_path).parts[0] for file in tmp_path.rglob("*.nbi")]
    assert indices == {"named": ["named"], "beside": ["code"], "nowhere": []}[place]
