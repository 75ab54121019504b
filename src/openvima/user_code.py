"""Functions of users by name: MODULE:FUNCTION or FILE.py:FUNCTION.

Loading runs the code. A name on the command line is trusted; one inside a file needs `--trust-code`.
"""

import hashlib
import importlib
import importlib.util
import re
import sys
import sysconfig
import traceback
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any

from openvima.errors import ConfigError, OpenVimaError
from openvima.input_files import open_regular

FORM = "MODULE:FUNCTION or FILE.py:FUNCTION"
_NAME = re.compile(r"(.+\.py|[^\W\d]\w*(\.[^\W\d]\w*)*):[^\W\d]\w*")
_loaded: dict[Path, tuple[str, ModuleType]] = {}  # sha256 of the source file, and its module


def is_code(source: str) -> bool:
    """Whether a text has the form MODULE:FUNCTION or FILE.py:FUNCTION; nothing is looked up."""
    return _NAME.fullmatch(source) is not None


def load_function(source: str, *, what: str) -> Callable[..., Any]:
    """Import the module or file of a function, and return the function.

    Args:
        source: MODULE:FUNCTION or FILE.py:FUNCTION.
        what: What the function is for, for errors, such as "policy".

    Raises:
        ConfigError: There is no such file, module or function, or its code raises when imported.
    """
    where, _, name = source.rpartition(":")
    if not is_code(source):
        raise ConfigError(f"{what} is {source!r}; name a function as {FORM}.")
    module = load_file(Path(where), what=what) if _is_file(where) else _load_module(where, what)
    function = getattr(module, name, None)
    if function is None:
        raise ConfigError(f"{what} is {source!r}, but {where} has no function {name!r}.")
    if not callable(function):
        raise ConfigError(f"{what} is {source!r}, which is a {type(function).__name__}; name a function.")
    return function


def call_function(source: str, *, what: str) -> Any:
    """Call a function without arguments, and return what it returns.

    Args:
        source: As in `load_function`.
        what: As in `load_function`.

    Raises:
        ConfigError: As for `load_function`, or the function needs arguments or raises.
    """
    function = load_function(source, what=what)
    try:
        return function()
    except OpenVimaError:
        raise
    except Exception as error:
        raise ConfigError(f"{what} is {source!r}, whose function raised {described(error)}.") from error


def load_file(path: Path, *, what: str) -> ModuleType:
    """Import a Python file from any folder; modules beside it can be imported by it.

    A file is run once, and again only if its content has changed.

    Args:
        path: The file.
        what: As in `load_function`.

    Raises:
        ConfigError: There is no such Python file, or its code raises.
    """
    try:
        with open_regular(path) as stream:
            code = stream.read()
    except (OSError, OpenVimaError):
        raise ConfigError(f"{what} names {str(path)!r}, and there is no such Python file.") from None
    path, digest = path.absolute(), hashlib.sha256(code).hexdigest()
    known, module = _loaded.get(path, ("", None))
    if module is not None and known == digest:
        return module
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # last, so that nothing installed is replaced
    spec = importlib.util.spec_from_file_location(_module_name(path, module), path)
    if spec is None:
        raise ConfigError(f"{what} names {str(path)!r}, which is no Python file; its name must end in .py.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        exec(compile(code, path, "exec"), module.__dict__)  # the bytes that the digest is of
    except (Exception, SystemExit) as error:
        del sys.modules[spec.name]
        raise ConfigError(f"{what} names {str(path)!r}, which raised {described(error)}.") from error
    _loaded[path] = digest, module
    return module


def load_entry_point(entry_point: EntryPoint) -> None:
    """Import what an installed package registers.

    Raises:
        ConfigError: It raises.
    """
    try:
        entry_point.load()
    except OpenVimaError:
        raise
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"the entry point {entry_point.name} = {entry_point.value!r} of {entry_point.group} raised "
            f"{described(error)}; repair or uninstall its package."
        ) from error


def source_hash(source: str, *, what: str) -> str:
    """SHA-256 of the source file of a function, as hexadecimal text; files that it imports are not hashed.

    Args:
        source: As in `load_function`; it is imported.
        what: As in `load_function`.

    Raises:
        ConfigError: As for `load_function`.
    """
    load_function(source, what=what)
    where = source.rpartition(":")[0]
    if _is_file(where):
        return _loaded[Path(where).absolute()][0]
    file = getattr(sys.modules[where], "__file__", None)
    return hashlib.sha256(Path(file).read_bytes() if file else source.encode()).hexdigest()


def with_absolute_path(source: str) -> str:
    """Return the name for a process with another working directory."""
    return str(Path(source).absolute()) if _is_file(source.rpartition(":")[0]) else source


def without_folder(source: str) -> str:
    """Return the name without the folder of its file, for records."""
    return Path(source).name if _is_file(source.rpartition(":")[0]) else source


def described(error: BaseException) -> str:
    """Describe an exception in one line, with the place in the code of the user."""
    text = " ".join(f"{type(error).__name__}: {error}".split()).rstrip(".: ")
    if isinstance(error, SyntaxError):
        return text  # it names file and line
    own = (str(Path(__file__).parent), sysconfig.get_path("stdlib"), sysconfig.get_path("purelib"), "<")
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith(own)]
    return f"{text} ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else text


def _is_file(where: str) -> bool:
    return where.endswith(".py")


def _load_module(name: str, what: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        if missing and f"{name}.".startswith(f"{missing}."):
            hint = f"name it as {name}.py:FUNCTION" if Path(f"{name}.py").is_file() else "set PYTHONPATH"
            raise ConfigError(f"{what} names {name!r}, and there is no such module; {hint}.") from None
        raise ConfigError(f"{what} names {name!r}, which raised {described(error)}.") from error


def _module_name(path: Path, earlier: ModuleType | None) -> str:
    """The stem, by which spawned processes can import the file, unless something else has that name."""
    if earlier is not None:
        return earlier.__name__
    if path.stem.isidentifier() and path.stem not in sys.modules:
        found = importlib.util.find_spec(path.stem)
        if found is not None and found.origin is not None and Path(found.origin) == path:
            return path.stem
    return f"openvima_user_{path.stem}_{hashlib.sha256(str(path).encode()).hexdigest()[:8]}"
