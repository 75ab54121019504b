"""Archives are read like the standard library reads them, only faster, and damage is named."""

import random
import struct
import zipfile
from pathlib import Path

import pytest

import published_data
from openvima.data.published_sources import ZipArchive
from openvima.errors import DatasetError

EPISODES = {
    "rotate/000003": {"obs.pkl": b"three", "rgb_top/0.jpg": bytes(300)},
    "rotate/000010": {"obs.pkl": b"ten", "action.pkl": b"a" * 1000},
    "same_profile/090000": {"trajectory.pkl": b"profile"},
}


def contents(archive: ZipArchive) -> dict[str, dict[str, bytes]]:
    return {folder: dict(archive.files(place)) for folder, place in archive.episodes.items()}


def with_root(root: str = "vima_v6/") -> dict[str, dict[str, bytes]]:
    return {f"{root}{folder}": files for folder, files in EPISODES.items()}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return published_data.write_zip(tmp_path / "vima.zip", EPISODES)


@pytest.mark.parametrize("root", ["", "a/b/", "vima_v6/"])
def test_the_folder_above_the_tasks_may_have_any_name(tmp_path: Path, root: str) -> None:
    path = published_data.write_zip(tmp_path / "a.zip", EPISODES, root)
    assert contents(ZipArchive(path)) == with_root(root)


def test_members_may_lie_in_any_order(tmp_path: Path) -> None:
    entries = [(f"{f}/{name}", content) for f, files in EPISODES.items() for name, content in files.items()]
    random.Random(0).shuffle(entries)
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:  # stored, not deflated
        for name, content in entries:
            archive.writestr(name, content)
    assert contents(ZipArchive(tmp_path / "a.zip")) == EPISODES


def test_archives_beyond_four_gigabytes_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With lower limits the standard library writes the 64-bit form for small files."""
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 50)
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 2)
    path = published_data.write_zip(tmp_path / "vima.zip", EPISODES)
    assert b"PK\6\6" in path.read_bytes()
    assert contents(ZipArchive(path)) == with_root()


def test_the_digest_stands_for_the_content(path: Path, tmp_path: Path) -> None:
    again = published_data.write_zip(tmp_path / "again.zip", EPISODES)
    changed = {**EPISODES, "rotate/000003": {"obs.pkl": b"THREE"}}
    other = published_data.write_zip(tmp_path / "other.zip", changed)
    digests = [ZipArchive(p).digest() for p in (path, again, other)]
    assert digests[0] == digests[1] != digests[2]
    assert len(digests[0]) == 32


def test_no_beginning_of_an_archive_reads_as_whole(path: Path) -> None:
    whole = path.read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 30, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(DatasetError, match=r"vima\.zip.*(interrupted download|no zip archive)"):
            ZipArchive(path)


def patched(path: Path, name: str, *, local: int, central: int, layout: str, value: int) -> Path:
    """Change a field of a member, in its head and in the directory."""
    content = bytearray(path.read_bytes())
    for magic, at, name_at in ((b"PK\3\4", local, 30), (b"PK\1\2", central, 46)):
        start = 0
        while content[start + name_at : start + name_at + len(name)] != name.encode():
            start = content.index(magic, start + 1)
        struct.pack_into(layout, content, start + at, value)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("offset", [2**31, 2**63 + 5, 2**64 - 1])
def test_a_member_beyond_the_end_is_named(tmp_path: Path, offset: int) -> None:
    name = b"rotate/000001/obs.pkl"
    extra = struct.pack("<HHQ", 1, 8, offset)
    head = struct.pack("<4s2B4HL2L2H", b"PK\3\4", 20, 0, 0, 0, 0, 0, 0, 1, 1, len(name), 0) + name + b"x"
    lengths = (len(name), len(extra), 0, 0, 0)
    entry = struct.pack("<4s4B4H3L5H2L", b"PK\1\2", 20, 0, 20, 0, 0, 0, 0, 0, 0, 1, 1, *lengths, 0, 2**32 - 1)
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, len(entry + name + extra), len(head), 0)
    (tmp_path / "a.zip").write_bytes(head + entry + name + extra + end)
    archive = ZipArchive(tmp_path / "a.zip")
    with pytest.raises(DatasetError, match=r"(obs\.pkl cannot be read|directory is damaged)"):
        archive.files(archive.episodes["rotate/000001"])


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    """It claims to be small, but would unpack to much more."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("rotate/000001/obs.pkl", bytes(2**24))
    name = "rotate/000001/obs.pkl"
    path = patched(tmp_path / "a.zip", name, local=22, central=24, layout="<L", value=1000)
    archive = ZipArchive(path)
    with pytest.raises(DatasetError, match=r"obs\.pkl cannot be read: Bad CRC-32"):
        archive.files(archive.episodes["rotate/000001"])


def test_flipped_bytes_never_pass_for_content(path: Path) -> None:
    """A changed byte is an error, or changed something that nobody asks for, such as a date."""
    whole = path.read_bytes()
    for at in range(0, len(whole), 3):
        content = bytearray(whole)
        content[at] ^= 0x15
        path.write_bytes(content)
        try:
            found = contents(ZipArchive(path))
        except DatasetError as error:
            assert len(str(error)) < 400
            continue
        for folder, files in found.items():
            for name, body in files.items():
                expected = [e[name] for e in EPISODES.values() if name in e]
                assert body in expected, (at, folder, name)
