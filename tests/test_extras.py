"""Optional packages: not installed, broken, or too large for the memory."""

from pathlib import Path

import pytest

from openvima.errors import MissingExtraError
from openvima.imports import import_extra, lacks_memory


@pytest.mark.parametrize(
    ("code", "kind", "message"),
    [
        (None, MissingExtraError, "^install it$"),
        ("import odd_package_within", MissingExtraError, "cannot be imported .*odd_package_within"),
        (
            "raise ImportError('no symbol x')",
            MissingExtraError,
            r"cannot be imported \(no symbol x\); install it",
        ),
        (
            "raise ImportError('failed to map segment from shared object')",
            MemoryError,
            "cannot be loaded",
        ),
        ("raise OSError(12, 'Cannot allocate memory')", MemoryError, "cannot be loaded"),
    ],
)
def test_only_a_missing_package_is_called_missing(
    code: str | None, kind: type[Exception], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    if code is not None:
        (tmp_path / "odd_package.py").write_text(code)
    with pytest.raises(kind, match=message):
        import_extra("odd_package", "install it")


def test_lack_of_memory_is_found_in_the_causes_of_an_exception() -> None:
    error = ValueError("no such library")
    error.__cause__ = OSError("a.so: failed to map segment from shared object")
    assert lacks_memory(error)
    assert not lacks_memory(ImportError("failed to map segment from shared object: Operation not permitted"))
    assert not lacks_memory(ValueError("memory"))
