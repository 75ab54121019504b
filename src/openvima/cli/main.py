"""The `openvima` program: dispatches to the module of the verb and reports errors in one line."""

import errno
import importlib
import sys
from collections.abc import Callable, Sequence

from openvima import __version__
from openvima.errors import OpenVimaError, unknown_name

# Verb → summary. Each verb is a module of this package.
VERBS = {
    "quickstart": "generate, train, evaluate and report in ten minutes",
    "tasks": "list the tasks: prompt, tool, levels, steps",
    "demo": "record a video of the oracle or a policy on one task",
    "generate": "generate demonstrations with the oracle",
    "data": "inspect, verify, convert, split and export demonstrations",
    "assets": "gallery of objects and textures; import of the original asset pack",
    "policies": "list policies; convert and export checkpoints",
    "train": "train a policy on demonstrations",
    "detector": "train and evaluate the object detector",
    "evaluate": "evaluate policies on levels L1 to L4",
    "serve": "serve a policy over WebSockets",
    "report": "write the HTML report of an evaluation",
}

_HELP = ("-h", "--help")

OVERVIEW = """openvima {version}: robot manipulation from multimodal prompts

Usage: openvima VERB [OPTIONS]      openvima VERB --help explains one verb

{verbs}

Begin with:  openvima quickstart --out quickstart
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Command-line arguments; by default those of the process.

    Returns:
        Exit status: 0 done, 1 failed, 2 wrong usage or input, 130 interrupted.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in (*_HELP, "help"):
        verbs = "\n".join(f"  {verb:<11} {summary}" for verb, summary in VERBS.items())
        print(OVERVIEW.format(version=__version__, verbs=verbs), end="")
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        print(__version__)
        return 0
    if words[0] not in VERBS:
        return _fail(unknown_name("verb", words[0], VERBS), 2)
    return _run(words[0], words[1:])


def _run(verb: str, rest: list[str]) -> int:
    import tyro

    module = importlib.import_module(f"openvima.cli.{verb}")
    commands: dict[str, Callable[..., int]] | None = getattr(module, "COMMANDS", None)
    try:
        if commands is not None:
            names_none = not rest or (rest[0].startswith("-") and rest[0] not in _HELP)
            if names_none and hasattr(module, "DEFAULT"):
                rest = [module.DEFAULT, *rest]
            return tyro.extras.subcommand_cli_from_dict(
                commands, prog=f"openvima {verb}", description=module.__doc__, args=rest
            )
        if hasattr(module, "run"):  # parses its own arguments
            return module.run(rest)
        return tyro.cli(module.main, prog=f"openvima {verb}", args=rest)
    except OpenVimaError as error:
        usage = isinstance(error, ValueError | KeyError | ImportError)
        return _fail(f"{type(error).__name__}: {error}", 2 if usage else 1)
    except KeyboardInterrupt:
        return _fail("interrupted; complete files were kept, and the same command resumes.", 130)
    except BrokenPipeError:  # the reader of our output, such as `head`, exited
        sys.stderr.close()
        return 1
    except OSError as error:  # an unusable path, or a full disk
        if error.filename is None:
            return _fail(f"{type(error).__name__}: {error}", 1)
        reason = error.strerror or type(error).__name__
        message = f"cannot use {error.filename}: {reason}. Give a path that can be read and written."
        return _fail(message, 1 if error.errno == errno.ENOSPC else 2)


def _fail(message: str, status: int) -> int:
    print(f"openvima: {message}", file=sys.stderr)
    return status


if __name__ == "__main__":
    sys.exit(main())
