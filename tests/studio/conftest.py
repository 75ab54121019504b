"""A studio and a browser for the tests of the panels: one of each for a module."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest

from studio_page import Page, browser_or_skip


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """The system's Chromium, with software WebGL."""
    yield from browser_or_skip()


@pytest.fixture(scope="module")
def open_studio() -> Iterator[Callable[..., Any]]:
    """Open studios with settings; those that were opened before stay open until the end of the module."""
    pytest.importorskip("viser", reason="the studio is an extra")
    from openvima.studio.app import Studio
    from openvima.studio.browser_session import StudioConfig

    opened: list[Studio] = []

    def open_with(**settings: Any) -> Studio:
        opened.append(Studio(StudioConfig(**settings)))
        return opened[-1]

    yield open_with
    for studio in opened:
        studio.close()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[[str], Page]]:
    """Open pages of studios, small ones: software rendering takes its time."""
    pages: list[Page] = []

    def open_at(url: str) -> Page:
        pages.append(Page(browser, url, width=900, height=500))
        return pages[-1]

    yield open_at
    for page in pages:
        page.raw.close()
