"""Checks the opcodes of a pickle before anything runs it."""

import pickle
import pickletools
from collections.abc import Container

from openvima.errors import InputFileError

MAX_TUPLE_SIZE = 1_000  # values in a tuple and in the tuples inside it
# Opcodes of plain values, containers, and instances of named classes.
OPCODES = frozenset(
    (
        *("PROTO", "FRAME", "STOP", "MARK", "NONE", "NEWTRUE", "NEWFALSE", "BININT1", "BININT2", "BININT"),
        *("LONG1", "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE", "BINUNICODE8"),
        *("SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "EMPTY_TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "TUPLE"),
        *("EMPTY_LIST", "APPEND", "APPENDS", "EMPTY_DICT", "SETITEM", "SETITEMS"),
        *("BINPUT", "LONG_BINPUT", "MEMOIZE", "BINGET", "LONG_BINGET"),
        *("GLOBAL", "STACK_GLOBAL", "REDUCE", "NEWOBJ", "BUILD"),
    )
)


def check_opcodes(
    content: bytes, *, max_operations: int, opcodes: Container[str] = OPCODES
) -> frozenset[str]:
    """Refuse unknown opcodes, and what would cost much time or memory.

    A tuple whose items repeat one tuple, and so on, takes exponential time to hash. Sizes of tuples are
    therefore followed through stack and memo.

    Args:
        content: The pickle.
        max_operations: Largest number of opcodes, and index of the memo.
        opcodes: Opcodes that are allowed.

    Returns:
        What its GLOBAL opcodes name, such as "collections OrderedDict".

    Raises:
        InputFileError: An opcode is not allowed, or there are too many, or a tuple is too large.
        pickle.UnpicklingError: It is damaged; so are `ValueError`, `LookupError` and what else
            `pickletools.genops` raises.
    """
    sizes: list[int] = []  # of the values on the stack; 1 for all that is no tuple
    marks: list[int] = []
    memo: dict[int, int] = {}
    names: set[str] = set()
    for number, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        name, consumed = opcode.name, len(opcode.stack_before)
        if number >= max_operations:
            raise InputFileError(f"it has more than {max_operations:,} opcodes; published files are shorter.")
        if name not in opcodes:
            raise InputFileError(f"it has the opcode {name}, which no published file needs; nothing was run.")
        if name == "MARK":
            marks.append(len(sizes))
            continue
        if name in ("MEMOIZE", "BINPUT", "LONG_BINPUT"):
            index = len(memo) if argument is None else argument
            if index > max_operations:  # `pickle` would allocate as many entries
                raise InputFileError(f"it has the memo index {index:,}; published files have smaller ones.")
            memo[index] = sizes[-1]
            continue
        if name == "GLOBAL":
            names.add(str(argument))
        if pickletools.markobject in opcode.stack_before:  # which, with "stackslice", stands for the values
            consumed += len(sizes) - marks.pop() - 2
        rest = len(sizes) - consumed
        if rest < (marks[-1] if marks else 0):
            raise pickle.UnpicklingError("stack underflow")
        size = 1 + sum(sizes[rest:]) if "TUPLE" in name else 1
        if name in ("BINGET", "LONG_BINGET"):
            size = memo[argument or 0]
        if size > MAX_TUPLE_SIZE:
            raise InputFileError(f"it has a tuple of more than {MAX_TUPLE_SIZE:,} values, with nested ones.")
        sizes[rest:] = [size] * len(opcode.stack_after)
    return frozenset(names)
