"""The `openvima` program: dispatches to the module of the verb and reports errors in one line."""

import importlib
import io
import sys
from collections.abc import Callable, Sequence
from contextlib import nullcontext

from openvima import __version__
from openvima.atomic_io import FREE_SPACE, NO_SPACE
from openvima.errors import (
    OpenVimaError,
    Terminated,
    echo,
    handle_unknown_words,
    one_word_warning,
    unknown_name,
)
from openvima.imports import lacks_memory
from openvima.input_files import expand_home

# Verb → summary. Each verb is a module of this package; its functions return an exit status, or None for 0.
VERBS = {
    "quickstart": "generate, train, evaluate and report in three minutes",
    "tasks": "list the tasks: prompt, tool, levels, steps",
    "demo": "record a video of the oracle or a policy on one task",
    "generate": "generate demonstrations with the oracle",
    "data": "inspect, verify, convert, split, export and push demonstrations",
    "assets": "gallery of objects and textures; import of the original asset pack",
    "policies": "list policies; convert, export and push checkpoints",
    "train": "train a policy on demonstrations",
    "detector": "train and evaluate the object detector",
    "evaluate": "evaluate policies on the levels",
    "verify-results": "confirm an evaluation from its recorded actions",
    "study": "run an experiment of the papers: train, evaluate, plot",
    "serve": "serve a policy over WebSockets",
    "studio": "step through episodes, ask policies why, compose and act, in a browser",
    "report": "write the HTML report of an evaluation",
}

_HELP = ("-h", "--help")
_MAX_MESSAGE = 4000  # characters
_RESUMES = "interrupted; complete files were kept, and the same command resumes."
_INTERRUPTED = {
    **dict.fromkeys(("generate", "data", "train", "detector", "evaluate", "study", "quickstart"), _RESUMES),
    "serve": "the policy is no longer served; goodbye.",
    "studio": "the studio is closed; goodbye.",
}
_SCORING = ("evaluate", "study", "quickstart")  # verbs that play many episodes
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
        Exit status: 0 done, 1 failed, 2 wrong usage or input, 130 interrupted, 143 ended by SIGTERM.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # letters that their encoding lacks
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in (*_HELP, "help"):
        verbs = "\n".join(f"  {verb:<15} {summary}" for verb, summary in VERBS.items())
        print(OVERVIEW.format(version=__version__, verbs=verbs), end="")
        return 0 if words else 2
    if words[0] in ("-V", "--version"):
        print(__version__)
        return 0
    if words[0] not in VERBS:
        return _fail(unknown_name("verb", words[0], VERBS), 2)
    one_warning = one_word_warning() if words[0] in _SCORING else nullcontext()
    with handle_unknown_words(lambda found: _fail(f"UnknownWordWarning: {found}", 0)), one_warning:
        return _run(words[0], words[1:])


def _run(verb: str, rest: list[str]) -> int:
    import tyro

    try:
        rest = [expand_home(word) for word in rest]
        module = importlib.import_module(f"openvima.cli.{verb.replace('-', '_')}")
        commands: dict[str, Callable[..., int | None]] | None = getattr(module, "COMMANDS", None)
        if commands is not None:
            names_none = not rest or (rest[0].startswith("-") and rest[0] not in _HELP)
            if names_none and hasattr(module, "DEFAULT"):
                rest = [module.DEFAULT, *rest]
            status = tyro.extras.subcommand_cli_from_dict(
                commands, prog=f"openvima {verb}", description=module.__doc__, args=rest
            )
        elif hasattr(module, "run"):  # parses its own arguments
            status = module.run(rest)
        else:
            status = tyro.cli(module.main, prog=f"openvima {verb}", args=rest)
        sys.stdout.flush()  # while a full disk can still be reported
        return status or 0
    except KeyboardInterrupt as error:
        status = 143 if isinstance(error, Terminated) else 130  # 128 and the signal, as shells say it
        return _fail(_INTERRUPTED.get(verb, "interrupted."), status)
    except BrokenPipeError:  # the reader of our output, such as `head`, exited
        sys.stderr.close()
        return 1
    except Exception as error:
        return _fail(*_explained(error))


def _explained(error: Exception) -> tuple[str, int]:
    """Return the line that reports an exception, and the exit status; raise it if it is a bug."""
    name = type(error).__name__
    if lacks_memory(error):
        remedy = "lower the size of batches or the number of workers"
        return f"out of memory; {remedy}. Complete files were kept.", 1
    if isinstance(error, OpenVimaError):
        return f"{name}: {error}", 2 if isinstance(error, ValueError | KeyError | ImportError) else 1
    if not isinstance(error, OSError):
        raise error
    reason = error.strerror or name
    if error.errno in NO_SPACE:
        return f"cannot write {error.filename or 'a file'}: {reason}. {FREE_SPACE}", 1
    if error.filename is None:
        return f"{name}: {error}", 1
    return f"cannot use {error.filename}: {reason}. Give a path that can be read and written.", 2


def _fail(message: str, status: int) -> int:
    """Print a message in one line; what it quotes of a file may hold anything."""
    print(f"openvima: {echo(message, _MAX_MESSAGE)}", file=sys.stderr)
    return status
