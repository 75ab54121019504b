"""HTML pages: one stylesheet and one Jinja environment for reports, galleries and data pages."""

import base64
import io
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from openvima.errors import MissingExtraError, PromptError

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


def notebook_html(template: str, **values: object) -> str | None:
    """Render a template of the folder `notebook`, for `_repr_html_`.

    Args:
        template: Name of a file in `templates/notebook`, without ".html.j2".
        values: Variables of the template.

    Returns:
        An HTML fragment. None, so that notebooks show the text representation, without Jinja, and where a
        prompt cannot be read.
    """
    try:
        return render_page(f"notebook/{template}", **values)
    except (MissingExtraError, PromptError):
        return None


def thumbnail_uri(rgb: np.ndarray, mask: np.ndarray | None = None, height: int = 64) -> str:
    """Encode an image as a small data URI.

    Args:
        rgb: Shape (3, H, W), uint8.
        mask: Pixels to cut out with their surroundings, shape (H, W), bool; None keeps all.
        height: In pixels.
    """
    from PIL import Image

    image = Image.fromarray(rgb.transpose(1, 2, 0))
    if mask is not None:
        image = image.crop(Image.fromarray(mask).getbbox())  # all of it where the mask is empty
    width = max(1, round(image.width * height / image.height))
    stream = io.BytesIO()
    image.resize((width, height), Image.Resampling.LANCZOS).save(stream, "PNG")
    return data_uri(stream.getvalue())


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
    environment.globals["thumbnail_uri"] = thumbnail_uri
    return environment
