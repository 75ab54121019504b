"""Faults at the writing system calls of a command, and what has to hold after each."""

import contextlib
import errno
import os
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

from fault_cases import INPUTS, Case
from fault_injection import Call, Decide, run
from fault_states import (
    TEMPORARY,
    CrashRecorder,
    Tree,
    TreeReader,
    damage,
    differences,
    key,
    label,
    visible,
    without_locks,
    write_tree,
)
from openvima.cli.main import main

CRASHES = ("kill", "torn write", "power cut")
KINDS = (*CRASHES, "full disk", "I/O error", "no memory", "clock jump", "killed worker")
_COPIES = ("sendfile", "copy_file_range")
_FILLING = ("open", "mkdir", "write", "pwrite", "writev", "truncate", "allocate", *_COPIES)
_DAY_S = 86_400.0


@dataclass
class Count:
    """Outcomes of one kind of fault.

    Args:
        injected: Faults.
        harmless: Commands that finished all the same, or had finished.
        resumed: Commands that failed or died; the same command then finished with the same bytes.
        failed: Promises that did not hold.
    """

    injected: int = 0
    harmless: int = 0
    resumed: int = 0
    failed: int = 0


@dataclass
class Outcome:
    """What faults did to one case.

    Args:
        verb: Such as "data merge".
        case: Command line.
        calls: Writing calls of an undisturbed run.
        points: Those at which faults were injected.
        states: Different contents that faults left.
        kinds: Kind of fault → counts.
        failures: One line for each broken promise.
    """

    verb: str
    case: str
    calls: int = 0
    points: int = 0
    states: int = 0
    kinds: dict[str, Count] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)


class Campaign:
    """Runs cases below one folder.

    Args:
        folder: Folder for everything.
    """

    def __init__(self, folder: Path) -> None:
        self.root, self._log = folder / "root", folder / "output"
        self._inputs: dict[str, Tree] = {}
        os.environ["OPENVIMA_CACHE"] = str(folder / "cache")

    def start(self, case: Case) -> Tree:
        """Return what the folder holds before a case."""
        tree: Tree = {}
        for name in case.inputs:
            tree |= self._input(name)
        for words in case.before:
            write_tree(self.root, tree)
            self._must(case, words)
            tree = TreeReader(self.root).read()
        return tree

    def execute(
        self, case: Case, decide: Decide | None = None, *, words: str = "", mappings: bool = False
    ) -> tuple[int, str]:
        """Run the command of a case; returns exit status and output."""
        function = self._function(case, words or case.words)
        status = run(function, decide, root=self.root, log=self._log, mappings=mappings)
        return status, self._log.read_text(encoding="utf-8", errors="replace")

    def read(self) -> Tree:
        """Return what the folder holds."""
        return TreeReader(self.root).read()

    def _function(self, case: Case, words: str) -> Callable[[], int]:
        def function() -> int:
            os.chdir(self.root)
            tempfile.tempdir = str(self.root / TEMPORARY)
            sys.argv[:] = ["openvima", *words.split()]
            with case.setup():
                return main(words.split()) if case.run is None else _as_verb(case.run)

        return function

    def _input(self, name: str) -> Tree:
        if name not in self._inputs:
            made = INPUTS[name]
            tree: Tree = {}
            for other in made.inputs:
                tree |= self._input(other)
            write_tree(self.root, tree)
            self._must(made, made.words)
            self._inputs[name] = self.read()
        return self._inputs[name]

    def _must(self, case: Case, words: str) -> None:
        status, output = self.execute(case, words=words)
        if status:
            raise RuntimeError(f"openvima {words}: status {status}\n{output}")


class CaseRun:
    """One case under faults.

    Args:
        campaign: Where it runs.
        case: The case.
        per_label: Points of each label; 0 takes all.
        max_points: Further limit; 0 is none.
        kinds: Kinds of faults.
    """

    def __init__(
        self, campaign: Campaign, case: Case, *, per_label: int, max_points: int, kinds: tuple[str, ...]
    ) -> None:
        self._campaign, self._case, self._kinds = campaign, case, kinds
        self._limits = per_label, max_points
        self.outcome = Outcome(case.verb, case.words)
        self._known: dict[str, str] = {}
        self._start = campaign.start(case)
        self._final = self._clean()
        self._expected = self._shown(self._final)

    def all(self) -> Outcome:
        """Inject all faults."""
        self._crash()
        for kind, number in (("full disk", errno.ENOSPC), ("I/O error", errno.EIO)):
            for point in self._points if kind in self._kinds else ():
                self._fail(kind, number, point)
        if "no memory" in self._kinds:
            self._starve()
        if "clock jump" in self._kinds:
            self._jump()
        if "killed worker" in self._kinds and self._case.parallel:
            self._kill_workers()
        self.outcome.states = len(self._known)
        return self.outcome

    def _clean(self) -> Tree:
        """Run undisturbed and choose the points."""
        self._reset()
        labels: list[str] = []
        status, output = self._campaign.execute(
            self._case, lambda call: labels.append(label(call, self._campaign.root))
        )
        if status:
            raise RuntimeError(f"openvima {self._case.words}: status {status}\n{output}")
        per_label, at_most = self._limits
        limits = [limit for limit in (at_most, self._case.max_points) if limit]
        self._points = chosen(labels, per_label, min(limits, default=0))
        self.outcome.calls, self.outcome.points = len(labels), len(self._points)
        return self._campaign.read()

    def _shown(self, tree: Tree) -> Tree:
        """Return the files that have to be equal; those with times in them need only be there."""
        return {
            path: b"" if Path(path).name in self._case.timed else content
            for path, content in visible(tree).items()
        }

    def _reset(self, tree: Tree | None = None) -> None:
        write_tree(self._campaign.root, self._start if tree is None else tree)

    def _crash(self) -> None:
        if not set(CRASHES) & set(self._kinds):
            return
        self._reset()
        recorder = CrashRecorder(self._campaign.root, frozenset(self._points))
        self._campaign.execute(self._case, recorder)
        found = differences(self._shown(self._campaign.read()), self._expected)
        if found:
            self.outcome.failures.append(f"two undisturbed runs differ: {found}")
        for (point, kind), tree in recorder.states.items():
            if kind in self._kinds:
                where = f"{kind} at call {point} ({recorder.calls[point]})"
                self._note(kind, where, self._judge(tree), self._shown(tree) == self._expected)

    def _fail(self, kind: str, number: int, point: int) -> None:
        """Let one call fail; a disk that is full stays so."""
        count, is_full = -1, False
        where = ""

        def decide(call: Call) -> int | None:
            nonlocal count, is_full, where
            count += 1
            if number == errno.ENOSPC and call.name in ("unlink", "rmdir", "chmod"):
                return None
            if count == point:
                is_full, where = number == errno.ENOSPC, label(call, self._campaign.root)
                return (call.write_half() if is_full else 0) or -number
            return -number if is_full and call.name in _FILLING else None

        self._reset()
        status, output = self._campaign.execute(self._case, decide)
        if where:
            self._after_error(kind, f"{kind} at call {point} ({where})", status, output)

    def _after_error(self, kind: str, where: str, status: int, output: str, *, lenient: bool = False) -> None:
        tree = self._campaign.read()
        is_done = self._shown(tree) == self._expected
        problem = ""
        if status == 0 and not is_done:
            problem = f"exit status 0, but {differences(self._shown(tree), self._expected)}"
        elif status != 0 and not lenient:
            problem = self._bad_message(kind, status, output)
        self._note(kind, where, problem or self._judge(tree), is_done)

    def _bad_message(self, kind: str, status: int, output: str) -> str:
        lines = output.strip().splitlines() or [""]
        if status not in (1, 2) or (kind == "full disk" and status != 1):
            return f"exit status {status}: {lines[-1][:200]}"
        if "Traceback" in output or not lines[-1].startswith("openvima: "):
            return f"no one-line error: {' / '.join(lines[-2:])[-300:]}"
        if kind == "killed worker":
            return "" if "worker" in lines[-1] else f"the error says nothing of the worker: {lines[-1][:200]}"
        if not any(name in lines[-1] for name in (*self._case.named, str(self._campaign.root))):
            return f"the error names no path: {lines[-1][:200]}"
        if kind == "full disk" and not any(hint in lines[-1] for hint in ("Free space", "Make room")):
            return f"the error says nothing of space: {lines[-1][:200]}"
        if ".tmp" in lines[-1] or ".partial" in lines[-1]:
            return f"the error names a temporary file: {lines[-1][:200]}"
        return ""

    def _starve(self) -> None:
        """Let all large mappings of memory from a number on fail."""
        total = 0

        def decide(call: Call) -> int | None:
            nonlocal total
            total += 1
            return -errno.ENOMEM if total > first else None

        first = sys.maxsize
        self._reset()
        self._campaign.execute(self._case, decide, mappings=True)
        per_label, _ = self._limits
        for first in spread(total, max(per_label, 2)):
            total = 0
            self._reset()
            status, output = self._campaign.execute(self._case, decide, mappings=True)
            where = f"no memory from mapping {first} on"
            # A library may end the process where it gets no memory: a crash, which has no message.
            is_crash = status < 0 or "Traceback" not in output
            self._after_error("no memory", where, status, output, lenient=is_crash)

    def _jump(self) -> None:
        """Let the clock jump back and forth by a day at each reading."""
        real, self._case = self._case, self._case.with_setup(_jumping_clock)
        self._reset()
        status, output = self._campaign.execute(self._case)
        self._case = real
        tree = self._campaign.read()
        found = differences(self._shown(tree), self._expected) or (f"status {status}" if status else "")
        self._note("clock jump", "clock jumps", found, True)
        if found:
            self.outcome.failures[-1] += f" {output.strip()[-200:]}"

    def _kill_workers(self) -> None:
        """Kill a worker process at a call of anyone."""
        first, count, has_killed = sys.maxsize, 0, False

        def decide(call: Call) -> None:
            nonlocal count, has_killed
            count += 1
            if count > first and not has_killed and (workers := _workers(call.process)):
                has_killed = True
                os.kill(workers[0], signal.SIGKILL)

        self._reset()
        self._campaign.execute(self._case, decide, words=self._case.parallel)
        found = differences(self._shown(self._campaign.read()), self._expected)
        if found:
            self.outcome.failures.append(f"`{self._case.parallel}` gives other bytes: {found}")
        for first in spread(count, min(self._limits[0] or 6, 6)):
            count, has_killed = 0, False
            self._reset()
            status, output = self._campaign.execute(self._case, decide, words=self._case.parallel)
            if has_killed:
                self._after_error("killed worker", f"a worker killed at call {first}", status, output)

    def _note(self, kind: str, where: str, problem: str, is_done: bool) -> None:
        count = self.outcome.kinds.setdefault(kind, Count())
        count.injected += 1
        if problem:
            count.failed += 1
            self.outcome.failures.append(f"{where}: {problem}")
        elif is_done:
            count.harmless += 1
        else:
            count.resumed += 1

    def _judge(self, tree: Tree) -> str:
        """Return what is wrong with what a fault left: files that are not whole, or no way to go on."""
        digest = key(tree)
        if digest not in self._known:
            self._known[digest] = self._damage(tree) or self._not_resumable(tree)
        return self._known[digest]

    def _damage(self, tree: Tree) -> str:
        shown = visible(tree)
        for path, content in shown.items():
            known = (self._start.get(path), self._final.get(path))
            if content is not None and content not in known and (found := damage(path, content)):
                return found
        lost = [
            path
            for path, content in visible(self._start).items()
            if path in self._expected and path not in shown and content not in _backups(tree, path)
        ]
        return f"{lost[0]} is lost" if lost and self._case.keeps else ""

    def _not_resumable(self, tree: Tree) -> str:
        if self._shown(tree) == self._expected:
            return ""
        self._reset(tree)
        status, output = self._campaign.execute(self._case)
        after = self._campaign.read()
        if found := differences(self._shown(after), self._expected):
            last = (output.strip().splitlines() or [""])[-1]
            return f"the same command again: status {status}, {found} ({last[:200]})"
        if status:
            return f"the same command again: status {status} ({output.strip()[-200:]})"
        if found := differences(_hidden(after), _hidden(self._final)):
            return f"the same command again: {found}"
        return ""


def _as_verb(function: Callable[[], int]) -> int:
    """Run a function as the program runs a verb, which reports errors."""
    with patch.dict(sys.modules, {"openvima.cli.studio": SimpleNamespace(run=lambda words: function())}):
        return main(["studio"])


def chosen(labels: list[str], per_label: int, max_points: int) -> list[int]:
    """Return the calls at which to inject faults: of those with one label the first, the last and between."""
    places: dict[str, list[int]] = {}
    for number, name in enumerate(labels):
        places.setdefault(name, []).append(number)
    points = sorted(
        numbers[index] for numbers in places.values() for index in spread(len(numbers), per_label)
    )
    return [points[index] for index in spread(len(points), max_points)]


def spread(length: int, number: int) -> list[int]:
    """Return so many indices of a list, evenly from the first to the last; 0 means all."""
    if not 0 < number < length:
        return list(range(length))
    if number == 1:
        return [length // 2]
    return sorted({round(index * (length - 1) / (number - 1)) for index in range(number)})


def _hidden(tree: Tree) -> Tree:
    shown, files = visible(tree), without_locks(tree)
    return {path: b"" for path, content in files.items() if content is not None and path not in shown}


def _backups(tree: Tree, path: str) -> list[bytes | None]:
    """Contents of a file in backups of it or of a folder that it is in."""
    parts = path.split("/")
    names = ["/".join([*parts[:i], f".{parts[i]}.old", *parts[i + 1 :]]) for i in range(len(parts))]
    return [tree[name] for name in names if name in tree]


def _workers(process: int) -> list[int]:
    """Return the processes that a process, or its parent, started for Python functions."""
    found = []
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            status = (file.parent / "stat").read_text().rpartition(")")[2].split()
            is_worker = b"spawn_main" in file.read_bytes()
            if is_worker and os.getsid(int(file.parent.name)) == os.getsid(process) and status[0] != "Z":
                found.append(int(file.parent.name))
    return sorted(found)


@contextlib.contextmanager
def _jumping_clock() -> Iterator[None]:
    real, count = time.time, Counter()

    def jump() -> float:
        count[""] += 1
        return real() + (_DAY_S if count[""] % 2 else -_DAY_S)

    time.time, time.time_ns = jump, lambda: int(jump() * 1e9)
    try:
        yield
    finally:
        time.time = real
