"""Unpickling published files without running their code.

A pickle is a program that may call any function. `read_pickle` first checks the opcodes, then runs them with
a `pickle.Unpickler` that knows a closed list of classes. Each is replaced by an inert stand-in that holds
arguments and state; other names are refused. Arrays and numbers are decoded from their stand-ins afterwards.
"""

import io
import pickle
import re
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

import numpy as np

from openvima.errors import InputFileError, MemberError
from openvima.pickle_opcodes import OPCODES, check_opcodes

_OPCODES = OPCODES | {"BYTEARRAY8"}  # in which protocol 5 writes the content of arrays
MAX_OPERATIONS = 100_000  # opcodes; the largest known file has about 3,000
_MAX_TEXT = 200  # characters of a name or reason that a message quotes
# What `pickle` raises when it is given damaged bytes.
_ODD_ERRORS = (
    *(pickle.UnpicklingError, LookupError, TypeError, ValueError, AttributeError, EOFError),
    *(ArithmeticError, MemoryError),
)
_DTYPE = re.compile(r"[<>|=]?[buif][1248]")

_NUMPY = ("numpy.core", "numpy._core")
_ENCYCLOPEDIA = tuple(f"{package}.tasks.components.encyclopedia" for package in ("vimasim", "vima_bench"))
ARRAYS = frozenset(f"{package}.multiarray._reconstruct" for package in _NUMPY)
BUFFERS = frozenset(f"{package}.numeric._frombuffer" for package in _NUMPY)  # arrays in protocol 5
SCALARS = frozenset(f"{package}.multiarray.scalar" for package in _NUMPY)
# Classes whose instances published files contain.
_CLASSES = frozenset(
    [
        *ARRAYS,
        *BUFFERS,
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
# Classes and functions that published files only refer to.
_NAMES = frozenset(
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


@dataclass(frozen=True)  # with slots, Python 3.11.2 would replace `__setstate__` by its own
class Global:
    """A class or function that a pickle only refers to, by its dotted name; nothing is imported."""

    name: str

    def __call__(self, *args: object) -> NoReturn:
        """Refuse to be called."""
        raise MemberError(f"it calls {self.name}, which no published file does; nothing was run.")

    def __setstate__(self, state: object) -> NoReturn:
        """Refuse to be changed."""
        raise MemberError(f"it changes {self.name}, which no published file does; nothing was run.")


class Record:
    """Stand-in for an instance of a class; it holds what the pickle says and does nothing.

    Args:
        args: Arguments of the constructor.
    """

    __slots__ = ("args", "state")
    name: ClassVar[str]  # dotted name of the class

    def __new__(cls, *args: object) -> "Record":
        """Hold the arguments; pickles also make instances without `__init__`."""
        record = super().__new__(cls)
        record.args, record.state = args, None
        return record

    def __setstate__(self, state: object) -> None:
        """Hold the state."""
        self.state = state

    def __setitem__(self, key: object, value: object) -> None:
        """Ignore the items of a mapping, which nothing reads."""


STAND_INS: dict[str, type[Record]] = {
    name: type(name.rpartition(".")[2], (Record,), {"__slots__": (), "name": name}) for name in _CLASSES
}


def read_pickle(content: bytes) -> Any:  # Any: whatever the file holds
    """Return the data in a pickle: plain values, lists, tuples, dictionaries, `Global` and `Record`.

    Args:
        content: The file.

    Raises:
        MemberError: It is damaged, too large, or more than data.
    """
    try:
        check_opcodes(content, max_operations=MAX_OPERATIONS, opcodes=_OPCODES)
        return _Unpickler(io.BytesIO(content)).load()
    except MemberError:
        raise
    except InputFileError as error:
        raise MemberError(str(error)) from None
    except _ODD_ERRORS as error:
        reason = str(error)[:_MAX_TEXT] or type(error).__name__
        raise MemberError(f"it is truncated or no pickle of data ({reason}).") from None


class _Unpickler(pickle.Unpickler):
    """Finds stand-ins only."""

    def find_class(self, module: str, name: str) -> type[Record] | Global:
        """Return the stand-in of a class, or the name of what is never called."""
        dotted = f"{module}.{name}"
        if dotted in STAND_INS:
            return STAND_INS[dotted]
        if dotted in _NAMES:
            return Global(dotted)
        raise MemberError(f"it names {dotted[:_MAX_TEXT]}, which no published file needs; nothing was run.")


def as_array(value: object) -> np.ndarray:
    """Decode the stand-in of an array; the result is read-only.

    Raises:
        MemberError: It is none, holds anything but numbers, or its size does not fit its shape.
    """
    try:
        if isinstance(value, Record) and value.name in BUFFERS:
            content, dtype, shape, order, *axes = value.args
            array = _frombuffer(content, dtype).reshape(shape, order="C" if order == "K" else order)
            return array.transpose(*axes) if order == "K" else array
        if isinstance(value, Record) and value.name in ARRAYS and isinstance(value.state, tuple):
            _, shape, dtype, by_columns, content = value.state
            return _frombuffer(content, dtype).reshape(shape, order="F" if by_columns else "C")
    except MemberError:
        raise
    except (TypeError, ValueError, OverflowError):
        raise MemberError("it has an array whose size, shape and type do not fit each other.") from None
    raise MemberError(f"it has {kind_of(value)} where an array should be.")


def as_plain(value: object) -> object:
    """Return the number in the stand-in of a NumPy scalar, and any other value as it is.

    Raises:
        MemberError: The number is damaged.
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
    """Describe a value in a word or two, without visiting nested values, which may be endless."""
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, str):
        return repr(value if len(value) <= 60 else value[:57] + "...")
    return value.name if isinstance(value, Global | Record) else f"a {type(value).__name__}"


def _frombuffer(content: object, dtype: object) -> np.ndarray:
    """View bytes as numbers; the result has the size of the bytes, whatever a file claims."""
    if not isinstance(dtype, Record) or dtype.name != "numpy.dtype":
        raise TypeError
    if not isinstance(content, bytes | bytearray):
        raise TypeError
    spec = dtype.args[0] if dtype.args else None
    if not isinstance(spec, str) or not _DTYPE.fullmatch(spec):
        raise MemberError(f"it has an array of type {kind_of(spec)}; only numbers are read.")
    order = dtype.state[1] if isinstance(dtype.state, tuple) and len(dtype.state) > 1 else "|"
    numbers = np.dtype(spec)
    numbers = numbers.newbyteorder(">") if order == ">" else numbers
    return np.frombuffer(memoryview(content).toreadonly(), numbers)
