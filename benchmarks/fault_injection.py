"""Run a function in a child process whose writing system calls are decided one by one; Linux on x86-64.

A seccomp filter with user notification stops each call that writes to files, also those of native libraries
and of further processes. The parent looks at it and lets it happen, fails it, shortens it, or kills someone.
"""

import array
import contextlib
import ctypes
import errno
import fcntl
import os
import platform
import select
import signal
import socket
import struct
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

# Numbers of x86-64 → name, and which arguments say where: "fd N", or "path N" with "at N" for its folder.
_CALLS: dict[int, tuple[str, tuple[str, ...]]] = {
    1: ("write", ("fd 0",)),
    18: ("pwrite", ("fd 0",)),
    20: ("writev", ("fd 0",)),
    40: ("sendfile", ("fd 0",)),
    326: ("copy_file_range", ("fd 2",)),
    74: ("fsync", ("fd 0",)),
    75: ("fsync", ("fd 0",)),
    77: ("truncate", ("fd 0",)),
    285: ("allocate", ("fd 0",)),
    91: ("chmod", ("fd 0",)),
    2: ("open", ("path 0",)),
    257: ("open", ("path 1 at 0",)),
    76: ("truncate", ("path 0",)),
    83: ("mkdir", ("path 0",)),
    258: ("mkdir", ("path 1 at 0",)),
    84: ("rmdir", ("path 0",)),
    87: ("unlink", ("path 0",)),
    263: ("unlink", ("path 1 at 0",)),
    82: ("rename", ("path 0", "path 1")),
    264: ("rename", ("path 1 at 0", "path 3 at 2")),
    316: ("rename", ("path 1 at 0", "path 3 at 2")),
    90: ("chmod", ("path 0",)),
    268: ("chmod", ("path 1 at 0",)),
}
_OPENS = {2: 1, 257: 2}  # number of the argument with the flags
_MMAP, _MAP_ANONYMOUS = 9, 0x20
LARGE_BYTES = 2**18  # a mapping that a lack of memory fails
_WRITES = ("write", "pwrite")  # which can be cut short
_AT_FDCWD = 0xFFFFFF9C
_ARCH, _PIDFD_OPEN, _PIDFD_GETFD, _SECCOMP = 0xC000003E, 434, 438, 317
_RECEIVE, _SEND = 0xC0502100, 0xC0182101
_NOTIFY, _ALLOW, _CONTINUE = 0x7FC00000, 0x7FFF0000, 1
_NOTICE, _ANSWER = struct.Struct("<QIIiIQ6Q"), struct.Struct("<QqiI")
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True, slots=True)
class Call:
    """A system call that is about to happen.

    Args:
        task: Id of the thread.
        name: Such as "write" or "rename".
        paths: What it changes; of "rename" the old and the new name.
        arguments: The six arguments as the system gets them.
    """

    task: int
    name: str
    paths: tuple[Path, ...]
    arguments: tuple[int, ...]

    @property
    def process(self) -> int:
        """Id of the process."""
        for line in Path(f"/proc/{self.task}/status").read_text().splitlines():
            if line.startswith("Tgid:"):
                return int(line.split()[1])
        raise ProcessLookupError(self.task)

    def first_half(self) -> tuple[int, bytes]:
        """Return where a "write" or "pwrite" would write, and the first half of its bytes."""
        descriptor, address, size = self.arguments[:3]
        if self.name == "pwrite":
            offset = self.arguments[3]
        else:
            fields = Path(f"/proc/{self.task}/fdinfo/{descriptor}").read_text().split()
            is_append = int(fields[fields.index("flags:") + 1], 8) & os.O_APPEND
            offset = self.paths[0].stat().st_size if is_append else int(fields[fields.index("pos:") + 1])
        return offset, _memory(self.task, address, size // 2)

    def write_half(self) -> int:
        """Let half of the bytes of a write be written; returns their number, at least 1 if it is no error."""
        if self.name not in _WRITES or self.arguments[2] < 2:
            return 0
        offset, half = self.first_half()
        process = _libc.syscall(_PIDFD_OPEN, self.process, 0)
        shared = _libc.syscall(_PIDFD_GETFD, process, ctypes.c_int(self.arguments[0]), 0)
        if shared < 0:
            raise OSError(ctypes.get_errno(), "the file of another process cannot be shared")
        try:  # the same open file, so that its position moves along
            return os.pwrite(shared, half, offset) if self.name == "pwrite" else os.write(shared, half)
        finally:
            os.close(shared)
            os.close(process)


Decide = Callable[[Call], int | None]  # None lets it happen, −errno fails it, n ≥ 0 is returned instead


def is_supported() -> bool:
    """Whether this system can notify a parent of the system calls of its child."""
    if platform.machine() != "x86_64" or not sys.platform.startswith("linux"):
        return False
    actions = Path("/proc/sys/kernel/seccomp/actions_avail")
    return actions.is_file() and "user_notif" in actions.read_text().split()


def run(
    function: Callable[[], int],
    decide: Decide | None,
    *,
    root: Path,
    log: Path,
    mappings: bool = False,
    timeout_s: float = 300.0,
) -> int:
    """Run a function in a forked process; further processes that it leaves behind are killed.

    Args:
        function: Returns an exit status.
        decide: Is asked about each call that changes something below the root; None asks about nothing.
        root: Folder.
        log: File for what it prints.
        mappings: Ask about mappings of `LARGE_BYTES` or more of memory, and about no writing.
        timeout_s: Time after which it is killed.

    Returns:
        Exit status; of a process that was killed, −1 times the signal.

    Raises:
        TimeoutError: It did not end.
    """
    ours, theirs = socket.socketpair()
    child = os.fork()
    if child == 0:
        ours.close()
        _run_child(function, theirs, log, None if decide is None else _filter(mappings))
    theirs.close()
    process = os.pidfd_open(child)
    _, descriptors, _, _ = socket.recv_fds(ours, 1, 1)
    ours.close()
    listener = descriptors[0] if descriptors else None
    try:
        _serve(process, listener, decide or (lambda call: None), root, time.monotonic() + timeout_s)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        os.close(process)
        if listener is not None:
            os.close(listener)
    return status


def _run_child(function: Callable[[], int], channel: socket.socket, log: Path, program: bytes | None) -> None:
    """Become the child; never returns."""
    status = 1
    try:
        os.setsid()
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(file, stream)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = os.fdopen(1, "w", closefd=False)
        sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
        if program is None:
            channel.sendall(b"-")
        else:
            listener = _install(program)
            socket.send_fds(channel, [b"+"], [listener])
            os.close(listener)
        channel.close()
        status = function()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
        finally:
            os._exit(status)


def _serve(process: int, listener: int | None, decide: Decide, root: Path, deadline: float) -> None:
    """Answer notices until the process ends."""
    poll = select.poll()
    poll.register(process, select.POLLIN)
    if listener is not None:
        poll.register(listener, select.POLLIN)
    while True:
        ready = dict(poll.poll(max(0.0, deadline - time.monotonic()) * 1000))
        if not ready:
            raise TimeoutError("it did not end")
        if process in ready:
            return
        assert listener is not None
        notice = bytearray(_NOTICE.size)
        try:
            fcntl.ioctl(listener, _RECEIVE, notice)
        except OSError as error:
            if error.errno in (errno.ENOENT, errno.EINTR):  # it was killed meanwhile
                continue
            raise
        id, task, _, number, _, _, *arguments = _NOTICE.unpack(notice)
        answer = None
        try:
            call = _call(task, number, tuple(arguments))
            if number == _MMAP or any(path.is_relative_to(root) for path in call.paths):
                answer = decide(call)
        except (ProcessLookupError, FileNotFoundError):  # it was killed meanwhile, or works on no file
            pass
        if answer is None:
            reply = _ANSWER.pack(id, 0, 0, _CONTINUE)
        elif answer < 0:
            reply = _ANSWER.pack(id, 0, answer, 0)
        else:
            reply = _ANSWER.pack(id, answer, 0, 0)
        try:
            fcntl.ioctl(listener, _SEND, reply)
        except OSError as error:
            if error.errno != errno.ENOENT:
                raise


def _call(task: int, number: int, arguments: tuple[int, ...]) -> Call:
    if number == _MMAP:
        return Call(task, "mmap", (), arguments)
    name, places = _CALLS[number]
    paths = []
    for place in places:
        kind, index, *at = place.split()
        if kind == "fd":
            paths.append(Path(os.readlink(f"/proc/{task}/fd/{arguments[int(index)] & 0xFFFFFFFF}")))
            continue
        folder = arguments[int(at[1])] & 0xFFFFFFFF if at else _AT_FDCWD
        base = os.readlink(f"/proc/{task}/" + ("cwd" if folder == _AT_FDCWD else f"fd/{folder}"))
        paths.append(Path(os.path.normpath(Path(base, _text(task, arguments[int(index)])))))
    return Call(task, name, tuple(paths), arguments)


def _memory(task: int, address: int, size: int) -> bytes:
    with open(f"/proc/{task}/mem", "rb", buffering=0) as memory:
        memory.seek(address)
        return memory.read(size)


def _text(task: int, address: int) -> str:
    """Return a text that ends with a zero; a read never crosses into the next page, which may be unmapped."""
    found = b""
    while b"\0" not in found:
        here = address + len(found)
        found += _memory(task, here, 4096 - here % 4096)
    return os.fsdecode(found.partition(b"\0")[0])


def _filter(mappings: bool) -> bytes:
    """Return the program that the system runs at each system call: which ones wait for an answer."""
    load, equal, bits, at_least, end = 0x20, 0x15, 0x45, 0x35, 0x06

    def argument(index: int) -> int:  # its lower half
        return 16 + 8 * index

    program: list[tuple[int, int, int, int]] = [(load, 0, 0, 4), (equal, 1, 0, _ARCH), (end, 0, 0, _ALLOW)]
    program.append((load, 0, 0, 0))
    if mappings:
        program += [(equal, 0, 6, _MMAP), (load, 0, 0, argument(3)), (bits, 0, 4, _MAP_ANONYMOUS)]
        program += [(load, 0, 0, argument(1)), (at_least, 1, 0, LARGE_BYTES), (end, 0, 0, _ALLOW)]
        program += [(end, 0, 0, _NOTIFY)]
    else:
        written = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
        for number in _CALLS:
            if number in _OPENS:
                program += [(equal, 0, 4, number), (load, 0, 0, argument(_OPENS[number]))]
                program += [(bits, 1, 0, written), (end, 0, 0, _ALLOW), (end, 0, 0, _NOTIFY)]
            else:
                program += [(equal, 0, 1, number), (end, 0, 0, _NOTIFY)]
    program.append((end, 0, 0, _ALLOW))
    return b"".join(struct.pack("<HBBI", *line) for line in program)


def _install(program: bytes) -> int:
    """Install the filter for this process and all that it starts; returns the descriptor of its notices."""
    lines = array.array("B", program)
    header = struct.pack("<HxxxxxxQ", len(program) // 8, lines.buffer_info()[0])
    pointer = ctypes.create_string_buffer(header)
    if _libc.prctl(38, 1, 0, 0, 0):  # no new privileges, without which it is refused
        raise OSError(ctypes.get_errno(), "no new privileges")
    listener = _libc.syscall(_SECCOMP, 1, 8, pointer)
    if listener < 0:
        raise OSError(ctypes.get_errno(), "the system gives no notice of system calls")
    return listener
