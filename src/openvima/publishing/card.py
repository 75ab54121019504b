"""Parts of the cards of policies and demonstrations: README.md of a repository on the Hub."""

import re
from collections.abc import Mapping
from typing import Any

import yaml

from openvima.errors import ConfigError, HubError, echo
from openvima.hub import HubName, hub_name
from openvima.report.typesetting import Line, Table, markdown

CARD_NAME = "README.md"
TAGS = ["openvima", "vima-bench", "multimodal-prompts", "imitation-learning"]
_LICENCE = re.compile(r"[a-z0-9][a-z0-9.+-]{0,63}")


def repository(text: str) -> HubName:
    """Read the name of the repository to push to.

    Raises:
        HubError: It is none.
    """
    name = hub_name(text if text.startswith("hf:") else f"hf://{text}")
    if name is None:
        raise HubError(f"{text!r} names no repository on the Hub; give OWNER/NAME or OWNER/NAME@BRANCH.")
    return name


def checked_licence(licence: str) -> str:
    """Return the identifier of a licence as the Hub writes it.

    Raises:
        ConfigError: It is none.
    """
    if not _LICENCE.fullmatch(licence.lower()):
        raise ConfigError(f"licence is {echo(repr(licence))}; give an identifier such as mit or cc-by-4.0.")
    return licence.lower()


def front_matter(values: Mapping[str, Any]) -> str:  # Any: plain values
    """Write the metadata of a card."""
    return f"---\n{yaml.safe_dump(dict(values), sort_keys=False, allow_unicode=True)}---\n"


def facts(caption: str, values: Mapping[str, object]) -> str:
    """Write a table of facts in Markdown, without those that are None or empty."""
    lines = tuple(
        Line(name, (echo(str(value)),)) for name, value in values.items() if value not in (None, "", [])
    )
    return markdown([Table("facts", caption, ("", ""), lines)])


def fenced(text: str, language: str = "") -> str:
    """Write a block of code, which nothing in the text can end."""
    return f"```{language}\n{text.replace('`', chr(39)).rstrip()}\n```\n"
