"""Arguments that several commands take; and options that are settings of a config class."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import tyro

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
Out = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
Policy = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
Repository = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OWNER/NAME")]
Task = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
Json = Annotated[bool, tyro.conf.arg(name="json")]


@dataclass(frozen=True, slots=True)
class EnvironmentOptions:
    """Tasks, prompts and control.

    Args:
        assets: procedural, original (see `openvima assets import`), a checkout of the original benchmark,
            or FILE.py:FUNCTION, which registers assets of your own.
        compat: Reproduce the quirks of the original benchmark; docs/compat.md lists them.
        prompts: multimodal; text, which puts a description such as "the red swirl letter A" in place of each
            object image; or mixed, which does so with probability ½. With ",paraphrased": synonyms.
        task_options: Options of tasks, [TASK.]NAME=VALUE with commas between them, such as
            num_distractors=3,rotate.difficulty=hard; `openvima tasks NAME` lists them. Without a task, for
            all that have the option.
        control: primitives; or end_effector, where an action moves the tool for 0.1 s (see
            docs/end_effector.md), for policies of that control and the oracle.
    """

    assets: str = "procedural"
    compat: bool = False
    prompts: str = "multimodal"
    task_options: str = ""
    control: Literal["primitives", "end_effector"] = "primitives"


Environment = tyro.conf.OmitArgPrefixes[EnvironmentOptions]
DEFAULT_ENVIRONMENT = EnvironmentOptions()

Config = TypeVar("Config")


def parse_config(
    config: type[Config],
    words: Sequence[str],
    *,
    default: Config,
    prog: str,
    description: str,
    shown: Collection[str] | None = None,
) -> Config:
    """Parse options to a config.

    Args:
        config: A dataclass of settings and of such dataclasses.
        words: The options.
        default: Its settings are those that are not given; `tyro.MISSING` ones must be given.
        prog: Name of the command.
        description: Text of its help.
        shown: Dotted names of the settings that help shows; None shows all.

    Raises:
        ConfigError: The config refuses a setting.
    """
    asks_help = {"-h", "--help"} & {*words}
    # The parser would report in a box of its own what a config refuses, so it gets one without checks.
    unchecked = _unchecked(default, shown if asks_help else None)
    parsed = tyro.cli(type(unchecked), prog=prog, description=description, args=words, default=unchecked)
    return config(**{setting.name: getattr(parsed, setting.name) for setting in fields(parsed)})


def _unchecked(default: Any, shown: Collection[str] | None, prefix: str = "") -> Any:
    """Return a config with the same settings, of a class without checks; it hides what is not shown."""
    kind, hints = type(default), get_type_hints(type(default), include_extras=True)
    settings = []
    for name, value in ((setting.name, getattr(default, setting.name)) for setting in fields(default)):
        hint = hints[name]
        if shown is not None and is_dataclass(value):
            value = _unchecked(value, shown, f"{prefix}{name}.")
            hint = type(value)
        elif shown is not None and prefix + name not in shown:
            hint = Annotated[hint, tyro.conf.Suppress]
        settings.append((name, hint, value))
    namespace = {"__doc__": kind.__doc__, "__post_init__": lambda self: None}
    return make_dataclass(kind.__name__, settings, bases=(kind,), frozen=True, namespace=namespace)()
