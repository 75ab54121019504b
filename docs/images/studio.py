"""Make studio_*.png beside this file: `PYTHONPATH=tests python docs/images/studio.py [NAME …]`.

It drives the studio in the system's browser, as the tests do; playwright and Chromium are needed.
"""

import io
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from PIL import Image

from openvima.studio.app import Studio
from openvima.studio.browser_session import StudioConfig
from studio_page import Page, launched_browser

SETTLED_S = 6.0  # until the camera and what was sent last are drawn, with software rendering
NUM_COLOURS = 256


def play(page: Page) -> None:
    """An episode in the middle."""
    page.choose("task", "rearrange_then_restore")
    page.wait_for("0 steps of at most")
    page.press("step")
    page.wait_for("1 step of at most")


def why(page: Page) -> None:
    """What openvima-small considers in an episode with two sensible picks."""
    page.tab("Why")
    page.check("show why")
    page.wait_for("Second most probable")


def compare(page: Page) -> None:
    """Two policies in lockstep."""
    page.choose("task", "visual_manipulation")
    page.wait_for("0 steps of at most")
    page.tab("Why")
    page.choose("compare with", "random")
    page.wait_for("No difference so far.")
    page.tab("Play")
    page.press("step")
    page.wait_for("solved in 1 step")
    page.tab("Why")
    page.wait_for("first difference")


def compose(page: Page) -> None:
    """A scene of one's own with the catalogue before the table."""
    page.tab("Compose")
    page.press("new scene")
    page.raw.get_by_role("button", name="new scene").wait_for()


SHOTS: dict[str, Callable[[Page], None]] = {"play": play, "why": why, "compare": compare, "compose": compose}


def take(shot: Callable[[Page], None], url: str, browser) -> bytes:
    """Return a picture of a page after what `shot` does, with few colours."""
    page = Page(browser, url, width=1300, height=800)
    page.raw.set_default_timeout(0)
    page.wait_for("0 steps of at most")
    page.raw.locator(".mantine-Notification-closeButton").first.click()  # of software rendering
    shot(page)
    page.raw.mouse.move(450, 30)  # away from what shows a hint
    time.sleep(SETTLED_S)
    image = Image.open(io.BytesIO(page.raw.screenshot(timeout=0)))
    page.raw.close()
    with io.BytesIO() as stream:
        image.convert("RGB").quantize(NUM_COLOURS, dither=Image.Dither.NONE).save(
            stream, "png", optimize=True
        )
        return stream.getvalue()


if __name__ == "__main__":
    with closing(Studio(StudioConfig())) as studio, launched_browser() as chromium:
        for name in sys.argv[1:] or SHOTS:
            target = Path(__file__).with_name(f"studio_{name}.png")
            target.write_bytes(take(SHOTS[name], studio.url, chromium))
