"""Options that are settings of a config class: parsing, a short help, and their names in errors."""

import re
from collections.abc import Collection, Sequence
from dataclasses import fields, is_dataclass, make_dataclass
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro

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


def setting_names(command: Any, prefix: str = "") -> list[str]:
    """Return the names of what a command or a config takes, as Python has them, with those of sections."""
    names = []
    for name, hint in get_type_hints(command, include_extras=True).items():
        plain = get_args(hint)[0] if get_origin(hint) is Annotated else hint
        if is_dataclass(plain):  # an annotated section is one whose name options omit
            names += setting_names(plain, prefix if hint is not plain else f"{prefix}{name}.")
        elif name != "return":
            names.append(prefix + name)
    return names


def name_options(message: str, settings: Collection[str]) -> str:
    """Name options in a message in place of settings: --loader.batch-size for loader.batch_size.

    Names of one plain word are replaced only where a message tells their value or what to do with them, since
    it may use the word itself.

    Args:
        message: A message of the package, which quotes what users gave.
        settings: Names of settings, see `setting_names`.
    """
    special = [re.escape(name) for name in settings if re.search(r"\W|_", name)]
    plain = [re.escape(name) for name in settings if not re.search(r"\W|_", name)]
    patterns = [
        rf"(?<![\w.(='\"`/-])({'|'.join(special)})(?![\w(='\"`/-]|\.\w)",
        rf"(?:^|(?<=[.;:] )|(?<=\bset )|(?<=\bleave ))({'|'.join(plain)})(?=,? (?:is|to|too|out)\b)",
    ]
    for names, pattern in zip((special, plain), patterns, strict=True):
        if not names:  # the pattern would match anywhere
            continue
        message = re.sub(pattern, lambda found: f"--{found[1].replace('_', '-')}", message)
    return message
