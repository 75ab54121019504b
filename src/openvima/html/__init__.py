"""HTML pages: one stylesheet and one Jinja environment for reports, galleries and data pages."""

import base64
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from openvima.errors import MissingExtraError

if TYPE_CHECKING:
    from jinja2 import Environment

_FOLDER = Path(__file__).parent


def render_page(template: str, **values: object) -> str:
    """Render a template of this package.

    Values are escaped, except for the SVG of charts. No line breaks before a percent sign. A page contains
    its stylesheet and loads nothing.

    Args:
        template: Name of a file in `templates`, without ".html.j2".
        values: Variables of the template.

    Returns:
        HTML.

    Raises:
        MissingExtraError: Jinja is not installed.
    """
    return _environment().get_template(f"{template}.html.j2").render(values)


def require_extra() -> None:
    """Check that pages can be rendered, before any work.

    Raises:
        MissingExtraError: Jinja is not installed.
    """
    _environment()


def data_uri(content: bytes, kind: str = "image/png") -> str:
    """Encode a file as a data URI of a media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def breakable(name: str) -> str:
    """Let a long name break after its underscores."""
    return name.replace("_", "_\u200b")


@cache
def _environment() -> "Environment":
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
        from markupsafe import Markup, escape
    except ImportError as error:
        message = "pages need Jinja; install it with: pip install 'openvima[report]'"
        raise MissingExtraError(message) from error
    environment = Environment(
        loader=FileSystemLoader([_FOLDER / "templates", _FOLDER]),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda v: v if isinstance(v, Markup) else escape(v).replace(" %", Markup("&nbsp;%")),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["breakable"] = breakable
    environment.globals["data_uri"] = data_uri
    return environment
