"""The verb `assets`: the gallery, the import, and what there is."""

import pytest

from openvima.catalog import original
from openvima.cli.main import main
from openvima.render import gallery


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENVIMA_CACHE", str(tmp_path / "cache"))


def import_small_pack(tmp_path, monkeypatch, *, damaged: bool = False) -> int:
    """Import a checkout in which every file is a body description without content."""
    names = ("kitting/object-template.urdf", "pallet/pallet.urdf")
    hashes = dict.fromkeys(names, "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855")
    monkeypatch.setattr(original, "known_hashes", lambda: hashes)
    folder = tmp_path / "checkout/vima_bench/tasks/assets"
    (folder / "textures").mkdir(parents=True)
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"")
    if damaged:
        (folder / "pallet/pallet.urdf").write_bytes(b"another")
    return main(["assets", "import", str(tmp_path / "checkout")])


@pytest.mark.slow
def test_a_gallery_prints_its_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gallery, "_pictures", lambda *_: ("", []))
    assert main(["assets", "gallery", "--out", str(tmp_path / "gallery")]) == 0
    page = tmp_path / "gallery" / "index.html"
    assert capsys.readouterr().out.strip() == str(page)
    assert "31 objects, 82 textures" in page.read_text(encoding="utf-8")


def test_an_import_says_how_many_files_it_took(tmp_path, monkeypatch, capsys):
    assert import_small_pack(tmp_path, monkeypatch) == 0
    assert "2 of 2 files imported" in capsys.readouterr().out
    assert main(["assets", "info"]) == 0
    assert "2 of 2 files imported" in capsys.readouterr().out


def test_an_incomplete_import_lists_what_it_lacks_and_ends_with_1(tmp_path, monkeypatch, capsys):
    assert import_small_pack(tmp_path, monkeypatch, damaged=True) == 1
    printed = capsys.readouterr()
    assert "1 of 2 files imported" in printed.out
    assert "1 not imported" in printed.err and "pallet/pallet.urdf differs" in printed.err
    assert len([path for path in original.imported_folder().rglob("*") if path.is_file()]) == 1


def test_info_without_an_import_names_the_command(capsys):
    assert main(["assets", "info"]) == 0
    assert "`openvima assets import CHECKOUT`" in capsys.readouterr().out


@pytest.mark.parametrize("words", [["demo", "rotate", "--out", "x.mp4"], ["generate", "--out", "demos"]])
def test_original_assets_without_an_import_are_refused_with_the_command(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*words, "--assets", "original"]) == 2
    message = capsys.readouterr().err
    assert "not been imported" in message and "`openvima assets import CHECKOUT`" in message
    assert not list(tmp_path.glob("*.mp4")) and not (tmp_path / "demos").exists()
