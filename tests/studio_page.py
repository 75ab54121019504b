"""Pages of the studio in the system's browser, for tests and for the pictures of docs/studio.md."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SOFTWARE_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
TIMEOUT_MS = 120_000  # for waiting: software rendering on a busy machine


def find_browser() -> str | None:
    """Return the path of the system's browser, if there is one."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def launched_browser() -> Iterator[Any]:
    """Launch the system's browser without a window."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=find_browser(), args=[*SOFTWARE_WEBGL])
        yield launched
        launched.close()


def browser_or_skip() -> Iterator[Any]:
    """Yield the system's browser for a fixture; skip where there is none."""
    pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    if find_browser() is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    with launched_browser() as launched:
        yield launched


class Page:
    """What a person does with a page of the studio; each call waits for what it needs.

    Args:
        browser: As `launched_browser` gives it.
        url: Address of the studio.
        width: Of the window, in pixels.
        height: Likewise.
    """

    def __init__(self, browser: Any, url: str, *, width: int, height: int) -> None:
        self.raw = browser.new_page(viewport={"width": width, "height": height})
        self.raw.set_default_timeout(TIMEOUT_MS)
        self.raw.goto(url)

    def wait_for(self, text: str) -> None:
        """Wait until a text is in view."""
        self.raw.get_by_text(text).first.wait_for()

    def tab(self, name: str) -> None:
        """Open a tab."""
        self.raw.get_by_role("tab", name=name).click()

    def press(self, button: str) -> None:
        """Press a button."""
        self.raw.get_by_role("button", name=button, exact=True).click()

    def press_at_once(self, *buttons: str) -> None:
        """Press buttons, one directly after the other."""
        press = "name => [...document.querySelectorAll('button')].find(b => b.textContent === name).click()"
        self.raw.evaluate(f"names => names.forEach({press})", [*buttons])

    def choose(self, label: str, option: str) -> None:
        """Choose from a dropdown."""
        self.raw.get_by_label(label, exact=True).first.click()
        self.raw.get_by_role("option", name=option, exact=True).first.click()

    def fill(self, label: str, text: str) -> None:
        """Fill a field, and leave it; viser's labels of text fields are not linked to them."""
        label_in_row = self.raw.get_by_text(label, exact=True).first
        field = label_in_row.locator("xpath=../../..").locator("input")
        field.fill(text)
        self.raw.keyboard.press("Enter")  # the field has the focus, or is gone where its text was enough

    def check(self, label: str) -> None:
        """Switch a checkbox."""
        self.raw.get_by_label(label, exact=True).first.click()
