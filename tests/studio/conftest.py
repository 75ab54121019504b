"""A studio and a browser for the tests of the panels: one of each for a module."""

import shutil
from collections.abc import Callable, Iterator
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SOFTWARE_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
TIMEOUT_MS = 120_000  # for waiting: software rendering on a busy machine


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:  # Any: playwright may be missing
    """The system's Chromium, with software WebGL."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    with sync_api.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=found, args=[*SOFTWARE_WEBGL])
        yield launched
        launched.close()


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
def open_page(browser: Any) -> Iterator[Callable[[str], "Page"]]:
    """Open pages of studios, small ones: software rendering takes its time."""
    pages: list[Page] = []

    def open_at(url: str) -> Page:
        raw = browser.new_page(viewport={"width": 900, "height": 500})
        raw.set_default_timeout(TIMEOUT_MS)
        raw.goto(url)
        pages.append(Page(raw))
        return pages[-1]

    yield open_at
    for page in pages:
        page.raw.close()


class Page:
    """What a person does with a page of the studio; each call waits for what it needs.

    Args:
        raw: Playwright's page.
    """

    def __init__(self, raw: Any) -> None:
        self.raw = raw

    def wait_for(self, text: str) -> None:
        """Wait until a text is in view."""
        self.raw.get_by_text(text).first.wait_for()

    def tab(self, name: str) -> None:
        """Open a tab."""
        self.raw.get_by_role("tab", name=name).click()

    def press(self, button: str) -> None:
        """Press a button."""
        self.raw.get_by_role("button", name=button, exact=True).click()

    def choose(self, label: str, option: str) -> None:
        """Choose from a dropdown."""
        self.raw.get_by_label(label, exact=True).first.click()
        self.raw.get_by_role("option", name=option, exact=True).first.click()

    def fill(self, label: str, text: str) -> None:
        """Fill a field, and leave it; viser's labels of text fields are not linked to them."""
        label_in_row = self.raw.get_by_text(label, exact=True).first
        field = label_in_row.locator("xpath=../../..").locator("input")
        field.fill(text)
        field.press("Enter")

    def check(self, label: str) -> None:
        """Switch a checkbox."""
        self.raw.get_by_label(label, exact=True).first.click()
