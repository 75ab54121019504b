"""Reading pickles without running them.

A pickle is a program for a machine that may call any function of any module. The machine here has only the
instructions that build data; where a file would call something, it notes name, arguments and state in a
`Record`. Names that the published files do not need are refused. What arrays and numbers mean is read from
their records afterwards, so no code of another library sees a byte before it was checked.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from openvima.errors import MemberError

MAX_OPERATIONS = 100_000  # the largest known file has about 3,000
_LONGEST_NAME = 200
_DTYPE = re.compile(r"[<>|=]?[buif][1248]")

_NUMPY = ("numpy.core.multiarray", "numpy._core.multiarray")
_ENCYCLOPEDIA = tuple(f"{package}.tasks.components.encyclopedia" for package in ("vimasim", "vima_bench"))
ARRAYS = frozenset(f"{module}._reconstruct" for module in _NUMPY)
SCALARS = frozenset(f"{module}.scalar" for module in _NUMPY)
# Classes of which files hold instances.
CLASSES = frozenset(
    [
        *ARRAYS,
        *SCALARS,
        "numpy.dtype",
        "functools.partial",
        "collections.defaultdict",
        *(f"{module}.definitions.SizeRange" for module in _ENCYCLOPEDIA),
        *(f"{module}.profiles.ProfilePedia" for module in _ENCYCLOPEDIA),
        "omegaconf.listconfig.ListConfig",
        "omegaconf.dictconfig.DictConfig",
        "omegaconf.base.ContainerMetadata",
        "omegaconf.base.Metadata",
        *(f"omegaconf.nodes.{kind}Node" for kind in ("Any", "String", "Integer", "Boolean")),
    ]
)
# What is only ever named.
NAMES = frozenset(
    [
        "numpy.ndarray",
        *("builtins.dict", "builtins.list", "builtins.int"),
        *("typing.Any", "typing.Union", "typing.Optional"),
        *(
            f"{module}.replace_fns.{function}"
            for module in _ENCYCLOPEDIA
            for function in ("_kit_obj_common", "container_replace_fn", "_google_scanned_obj_common")
        ),
    ]
)


@dataclass(frozen=True, slots=True)
class Global:
    """A class or function that a pickle names, by its dotted name; nothing was imported."""

    name: str


@dataclass(slots=True, eq=False)
class Record:
    """What would have been an instance of a class: how to make it, but not made.

    Args:
        name: Dotted name of the class.
        args: What it would have been called with.
        state: What it would have been given afterwards.
    """

    name: str
    args: tuple
    state: object = None


def read_pickle(content: bytes) -> Any:  # Any: whatever the file holds
    """Return what a pickle holds: plain values, lists, tuples, dictionaries, `Global` and `Record`.

    Args:
        content: The file.

    Raises:
        MemberError: It is damaged, too long, or needs more than data.
    """
    machine = _Machine(content)
    try:
        return machine.run()
    except MemberError:
        raise
    except (IndexError, KeyError, TypeError, ValueError, AttributeError, struct.error):
        raise MemberError(
            f"it is no pickle of data, or ends too early (byte {machine.position:,} of {len(content):,})."
        ) from None


def as_array(value: object) -> np.ndarray:
    """Decode the record of an array; the result is read-only.

    Raises:
        MemberError: It is none, it holds anything but numbers, or its size does not fit its shape.
    """
    if not isinstance(value, Record) or value.name not in ARRAYS or not isinstance(value.state, tuple):
        raise MemberError(f"it has {kind_of(value)} where an array should be.")
    try:
        _, shape, dtype, by_columns, content = value.state
        return _frombuffer(content, dtype).reshape(shape, order="F" if by_columns else "C")
    except MemberError:
        raise
    except (TypeError, ValueError, OverflowError):
        raise MemberError("it has an array whose size, shape and type do not fit each other.") from None


def as_plain(value: object) -> object:
    """Return the number that a record of a NumPy scalar holds, and any other value as it is.

    Raises:
        MemberError: The record is damaged.
    """
    if not isinstance(value, Record) or value.name not in SCALARS:
        return value
    try:
        dtype, content = value.args
        return _frombuffer(content, dtype).reshape(()).item()
    except MemberError:
        raise
    except (TypeError, ValueError):
        raise MemberError("it has a number whose size and type do not fit.") from None


def kind_of(value: object) -> str:
    """Describe a value in a word or two; nested ones are not looked into, they may be endless."""
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, str):
        return repr(value if len(value) <= 60 else value[:57] + "...")
    return value.name if isinstance(value, Global | Record) else f"a {type(value).__name__}"


def _frombuffer(content: object, dtype: object) -> np.ndarray:
    """Bytes as numbers; the size of the result is that of the bytes, whatever a file claims."""
    if not isinstance(dtype, Record) or dtype.name != "numpy.dtype" or not isinstance(content, bytes):
        raise TypeError
    spec = dtype.args[0] if dtype.args else None
    if not isinstance(spec, str) or not _DTYPE.fullmatch(spec):
        raise MemberError(f"it has an array of type {kind_of(spec)}; only numbers are read.")
    order = dtype.state[1] if isinstance(dtype.state, tuple) and len(dtype.state) > 1 else "|"
    numbers = np.dtype(spec)
    return np.frombuffer(content, numbers.newbyteorder(">") if order == ">" else numbers)


class _Machine:
    """Reads one pickle; see `pickletools` for the instructions."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.position = 0
        self.stack: list[Any] = []  # Any: whatever the file holds
        self.marks: list[int] = []
        self.memo: dict[int, object] = {}

    def run(self) -> object:
        """Follow the instructions up to the last one."""
        for _ in range(MAX_OPERATIONS):
            code = self.content[self.position : self.position + 1]
            self.position += 1
            if code == b".":
                return self.stack.pop()
            instruction = _INSTRUCTIONS.get(code)
            if instruction is None:
                raise MemberError(_refusal(code))
            instruction(self)
        raise MemberError(f"it has more than {MAX_OPERATIONS:,} instructions; published files are shorter.")

    def take(self, num_bytes: int) -> bytes:
        """The next bytes."""
        taken = self.content[self.position : self.position + num_bytes]
        if len(taken) < num_bytes:
            raise IndexError
        self.position += num_bytes
        return taken

    def number(self, layout: str) -> Any:  # Any: int or float
        """The next number."""
        return struct.unpack(layout, self.take(struct.calcsize(layout)))[0]

    def line(self) -> str:
        """The next line of text."""
        end = self.content.index(b"\n", self.position, self.position + _LONGEST_NAME)
        return self.take(end + 1 - self.position)[:-1].decode()

    def push(self, value: object) -> None:
        self.stack.append(value)

    def since_mark(self) -> list[Any]:  # Any: whatever the file holds
        """Take everything above the last mark."""
        mark = self.marks.pop()
        taken = self.stack[mark:]
        del self.stack[mark:]
        return taken

    def push_last(self, count: int) -> None:
        """Join the last values to a tuple."""
        if len(self.stack) < count:
            raise IndexError
        self.stack[-count:] = [tuple(self.stack[-count:])]

    def extend(self, values: list[Any]) -> None:
        """Append to the list below."""
        if isinstance(self.stack[-1], Record):
            raise MemberError(f"it fills {self.stack[-1].name}, which is not needed to read it.")
        self.stack[-1].extend(values)

    def update(self, pairs: list[Any]) -> None:
        """Write into the dictionary below."""
        target, keys = self.stack[-1], pairs[::2]
        for key in keys:
            # Hashes of nested tuples can take forever.
            if not isinstance(key, str | int | float | bytes | None):
                raise MemberError(f"it has {kind_of(key)} as a key; only texts and numbers are read.")
        if isinstance(target, dict):
            target.update(zip(keys, pairs[1::2], strict=True))
        elif not isinstance(target, Record):
            raise TypeError

    def name(self, module: str, name: str) -> None:
        """Note the name of a class or function."""
        dotted = f"{module}.{name}"
        if dotted not in CLASSES and dotted not in NAMES:
            raise MemberError(
                f"it names {dotted[:_LONGEST_NAME]}, which no published file needs; nothing was run."
            )
        self.push(Global(dotted))

    def record(self, args: object) -> None:
        """Note an instance of the class below."""
        made = self.stack.pop()
        if not isinstance(made, Global) or made.name not in CLASSES or not isinstance(args, tuple):
            raise MemberError(f"it calls {kind_of(made)}, which no published file does; nothing was run.")
        self.push(Record(made.name, args))

    def state(self, state: object) -> None:
        """Note the state of the instance below."""
        target = self.stack[-1]
        if not isinstance(target, Record):
            raise MemberError(f"it changes {kind_of(target)}, which no published file does; nothing was run.")
        target.state = state

    def name_of_stack(self) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        if not isinstance(name, str) or not isinstance(module, str):
            raise TypeError
        self.name(module, name)

    def instance(self) -> None:
        """The old form of naming and calling in one."""
        args = tuple(self.since_mark())
        self.name(self.line(), self.line())
        self.record(args)


_Instruction = Callable[[_Machine], object]


def _refusal(code: bytes) -> str:
    """What to say about an instruction that the machine does not have."""
    import pickletools

    if not code:
        return "it ends before its last instruction (an interrupted copy?)."
    known = {opcode.code.encode("latin-1"): opcode.name for opcode in pickletools.opcodes}
    shown = known.get(code, f"0x{code.hex()}")
    return f"it has the instruction {shown}, which no published file needs; nothing was run."


def _text(machine: _Machine, layout: str) -> None:
    machine.push(machine.take(machine.number(layout)).decode("utf-8", "surrogatepass"))


# Memo numbers are keys of a dictionary, so a huge one costs nothing.
_INSTRUCTIONS: dict[bytes, _Instruction] = {
    # Where the file begins, and lengths that only help those who read in pieces.
    b"\x80": lambda m: m.take(1),
    b"\x95": lambda m: m.take(8),
    # Values.
    b"N": lambda m: m.push(None),
    b"\x88": lambda m: m.push(True),
    b"\x89": lambda m: m.push(False),
    b"K": lambda m: m.push(m.number("<B")),
    b"M": lambda m: m.push(m.number("<H")),
    b"J": lambda m: m.push(m.number("<i")),
    b"\x8a": lambda m: m.push(int.from_bytes(m.take(m.number("<B")), "little", signed=True)),
    b"G": lambda m: m.push(m.number(">d")),
    b"\x8c": lambda m: _text(m, "<B"),
    b"X": lambda m: _text(m, "<I"),
    b"\x8d": lambda m: _text(m, "<Q"),
    b"C": lambda m: m.push(m.take(m.number("<B"))),
    b"B": lambda m: m.push(m.take(m.number("<I"))),
    b"\x8e": lambda m: m.push(m.take(m.number("<Q"))),
    # Containers.
    b"(": lambda m: m.marks.append(len(m.stack)),
    b"1": lambda m: m.since_mark(),
    b"0": lambda m: m.stack.pop(),
    b")": lambda m: m.push(()),
    b"\x85": lambda m: m.push_last(1),
    b"\x86": lambda m: m.push_last(2),
    b"\x87": lambda m: m.push_last(3),
    b"t": lambda m: m.push(tuple(m.since_mark())),
    b"]": lambda m: m.push([]),
    b"a": lambda m: m.extend([m.stack.pop()]),
    b"e": lambda m: m.extend(m.since_mark()),
    b"}": lambda m: m.push({}),
    b"s": lambda m: m.update([m.stack.pop(-2), m.stack.pop()]),
    b"u": lambda m: m.update(m.since_mark()),
    # What was noted before.
    b"q": lambda m: m.memo.__setitem__(m.number("<B"), m.stack[-1]),
    b"r": lambda m: m.memo.__setitem__(m.number("<I"), m.stack[-1]),
    b"\x94": lambda m: m.memo.__setitem__(len(m.memo), m.stack[-1]),
    b"h": lambda m: m.push(m.memo[m.number("<B")]),
    b"j": lambda m: m.push(m.memo[m.number("<I")]),
    # Names and instances: noted, never imported or called.
    b"c": lambda m: m.name(m.line(), m.line()),
    b"\x93": lambda m: m.name_of_stack(),
    b"i": lambda m: m.instance(),
    b"R": lambda m: m.record(m.stack.pop()),
    b"\x81": lambda m: m.record(m.stack.pop()),
    b"b": lambda m: m.state(m.stack.pop()),
}
