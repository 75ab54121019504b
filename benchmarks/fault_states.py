"""Contents of a folder in memory: what a fault or a crash leaves, and whether files are whole."""

import errno
import hashlib
import io
import json
import os
import re
import shutil
import stat
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

from fault_injection import Call

Tree = dict[str, bytes | None]
"""Path below a root → content; None for a folder."""

TEMPORARY = "tmp"  # folder below the root for temporary files, which is no part of its content
_PROCESS_ID = re.compile(r"\.\d+(?=\.tmp$|$)")
_HIDDEN = re.compile(r"(^|/)\.[^/]*\.(tmp|old)(/|$)|(^|/)\.lock[^/]*$|\.partial(/|$)")


def is_hidden(path: str) -> bool:
    """Whether a path is that of a lock, or temporary, so that no reader looks at it."""
    return bool(_HIDDEN.search(path))


def is_log(path: str) -> bool:
    """Whether the content of a path depends on time and machine."""
    return "log" in path


def visible(tree: Tree) -> Tree:
    """Return the files that a command promises: no temporary ones, no locks, no logs."""
    return {
        path: content
        for path, content in tree.items()
        if content is not None and not is_hidden(path) and not is_log(path)
    }


def without_locks(tree: Tree) -> Tree:
    """Return all files but locks and logs, which hold times and process ids, under names without those."""
    return {
        _PROCESS_ID.sub(".PID", path): content
        for path, content in tree.items()
        if "/.lock" not in f"/{path}" and not is_log(path)
    }


def key(tree: Tree) -> str:
    """Return a digest; trees that differ only by process ids, times and logs have the same."""
    digest = hashlib.sha256()
    for path, content in sorted(without_locks(tree).items()):
        digest.update(repr((path, None if content is None else hashlib.sha256(content).digest())).encode())
    return digest.hexdigest()


def differences(tree: Tree, expected: Tree) -> str:
    """Name a few files that are missing, unexpected or different; empty if there are none."""
    found = [f"{path} is missing" for path in sorted(expected.keys() - tree.keys())]
    found += [f"{path} is there" for path in sorted(tree.keys() - expected.keys())]
    found += [f"{path} differs" for path in sorted(tree.keys() & expected) if tree[path] != expected[path]]
    return ", ".join(found[:3]) + (f" and {len(found) - 3} more" if len(found) > 3 else "")


def write_tree(root: Path, tree: Tree) -> None:
    """Make a folder hold exactly a tree."""
    shutil.rmtree(root, ignore_errors=True)
    for folder in (root, root / TEMPORARY):
        folder.mkdir()
    for path, content in sorted(tree.items()):
        if content is None:
            (root / path).mkdir(parents=True, exist_ok=True)
        else:
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).write_bytes(content)


class TreeReader:
    """Reads a folder again and again; files that did not change are not read anew.

    Args:
        root: The folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._known: dict[int, tuple[tuple[int, ...], bytes]] = {}

    def read(self) -> Tree:
        """Return its content."""
        tree: Tree = {}
        self._add(tree, self._root, "")
        return tree

    def forget(self, path: Path) -> None:
        """Read a file anew the next time, even if its size and times are as they were."""
        with_status = _status(path)
        if with_status is not None:
            self._known.pop(with_status.st_ino, None)

    def _add(self, tree: Tree, folder: Path, prefix: str) -> None:
        for entry in os.scandir(folder):
            path = f"{prefix}{entry.name}"
            if path == TEMPORARY:
                continue
            if entry.is_dir(follow_symlinks=False):
                tree[path] = None
                self._add(tree, Path(entry.path), f"{path}/")
            elif entry.is_file(follow_symlinks=False):
                tree[path] = self._content(entry)

    def _content(self, entry: os.DirEntry[str]) -> bytes:
        status = entry.stat(follow_symlinks=False)
        seen = (status.st_size, status.st_mtime_ns, status.st_ctime_ns)
        known = self._known.get(status.st_ino)
        if known is None or known[0] != seen:
            known = (seen, Path(entry.path).read_bytes())
            self._known[status.st_ino] = known
        return known[1]


@dataclass
class CrashRecorder:
    """Notes, at each call of one run, what a crash at that moment would leave.

    Args:
        root: Folder.
        wanted: Numbers of the calls; None for all.
        calls: Labels of the calls so far.
        states: Number of a call and kind of crash → tree.
    """

    root: Path
    wanted: frozenset[int] | None = None
    calls: list[str] = field(default_factory=list)
    states: dict[tuple[int, str], Tree] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._reader = TreeReader(self.root)
        self._synced: dict[int, int] = {}  # file that is not on the disk → bytes of it that are
        self._pending: dict[int, int] = {}  # thread → file whose fsync it waits for

    def __call__(self, call: Call) -> None:
        """Note the states before and amid a call."""
        if self._pending:  # the thread goes on, so it has returned
            self._synced.pop(self._pending.pop(call.task, 0), None)
        number = len(self.calls)
        self.calls.append(label(call, self.root))
        if self.wanted is None or number in self.wanted:
            self._note(number, call)
        self._follow(call)

    def _note(self, number: int, call: Call) -> None:
        tree = self._reader.read()
        self.states[number, "kill"] = tree
        if call.name in ("write", "pwrite") and call.arguments[2] > 1:
            place = _relative(call.paths[0], self.root)
            if isinstance(content := tree.get(place), bytes):
                offset, half = call.first_half()
                start = content[:offset].ljust(offset, b"\0")
                torn = start + half + content[offset + len(half) :]
                self.states[number, "torn write"] = {**tree, place: torn}
        lost = {
            place: content[: self._synced[inode]]
            for place, content in tree.items()
            if content and (inode := (self.root / place).stat().st_ino) in self._synced
        }
        if any(lost[place] != tree[place] for place in lost):
            self.states[number, "power cut"] = {**tree, **lost}

    def _follow(self, call: Call) -> None:
        status = _status(call.paths[-1])
        if status is None or not stat.S_ISREG(status.st_mode):
            return
        if call.name == "fsync":
            self._pending[call.task] = status.st_ino
        elif call.name in ("unlink", "rename"):  # of what a rename replaces
            self._synced.pop(status.st_ino, None)
        elif call.name not in ("open", "chmod") or (call.name == "open" and _truncates(call)):
            self._reader.forget(call.paths[-1])
            synced = 0 if call.name == "open" else status.st_size
            self._synced[status.st_ino] = min(synced, self._synced.get(status.st_ino, synced))


def label(call: Call, root: Path) -> str:
    """Return what a call does where, the same for calls on files that differ by numbers only."""
    name = _relative(call.paths[-1], root)
    return f"{call.name} {re.sub(r'[0-9]+|tmp[a-z0-9_]{8}', '#', name)}"


def _truncates(call: Call) -> bool:
    flags = next(argument for argument in call.arguments[1:3] if argument & (os.O_WRONLY | os.O_RDWR))
    return bool(flags & os.O_TRUNC)


def _relative(path: Path, root: Path) -> str:
    return str(path.relative_to(root)) if path.is_relative_to(root) else path.name


def _status(path: Path) -> os.stat_result | None:
    try:
        return path.lstat()
    except OSError as error:
        if error.errno in (errno.ENOENT, errno.ENOTDIR):
            return None
        raise


def damage(path: str, content: bytes) -> str:
    """Return why a file is not whole, judged by a reader of its format; empty if it is."""
    try:
        _READERS.get(Path(path).suffix, _any)(content)
    except Exception as error:
        return f"{path} is not whole ({type(error).__name__}: {str(error)[:80]})"
    return ""


def _any(content: bytes) -> None:
    """Any content is whole in a format that has no end."""


def _lines(content: bytes) -> None:
    for line in content.splitlines()[:-1]:  # readers skip a last one that is cut
        json.loads(line)


def _yaml(content: bytes) -> None:
    import yaml

    assert isinstance(yaml.safe_load(content), dict), "no mapping"


def _html(content: bytes) -> None:
    assert content.rstrip().endswith(b"</html>"), "no end"


def _text(content: bytes) -> None:
    assert content, "empty"


def _arrow(content: bytes) -> None:
    import pyarrow as pa

    pa.ipc.open_file(pa.BufferReader(content)).read_all()


def _parquet(content: bytes) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.read_table(pa.BufferReader(content))


def _tensors(content: bytes) -> None:
    from safetensors.torch import load

    load(content)


def _image(content: bytes) -> None:
    from PIL import Image

    Image.open(io.BytesIO(content)).load()


def _video(content: bytes) -> None:
    import av

    with av.open(io.BytesIO(content), "r") as video:
        assert sum(1 for _ in video.decode(video=0)), "no frames"


def _archive(content: bytes) -> None:
    assert zipfile.ZipFile(io.BytesIO(content)).testzip() is None, "damaged member"


_READERS = {
    ".json": json.loads,
    ".jsonl": _lines,
    ".yaml": _yaml,
    ".html": _html,
    ".md": _text,
    ".tex": _text,
    ".txt": _text,
    ".arrow": _arrow,
    ".parquet": _parquet,
    ".safetensors": _tensors,
    ".png": _image,
    ".mp4": _video,
    ".zip": _archive,
}
