"""Make studio_*.png beside this file: `PYTHONPATH=tests python docs/images/studio.py [NAME …]`.

It drives the studio in the system's browser, as the tests do; playwright and Chromium are needed.
"""

import io
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import chdir, closing
from pathlib import Path

from PIL import Image

from openvima.evaluation import EvaluationConfig, evaluate
from openvima.policies.naming import SMALL
from openvima.studio.app import Studio
from openvima.studio.browser_session import StudioConfig
from studio_page import Page, launched_browser

SETTLED_S = 6.0  # until the camera and what was sent last are drawn, with software rendering
NUM_COLOURS = 256
HEART_PX = (542, 412)  # where the heart of `visual_manipulation`, seed 3, is in view
RESULTS = "results"  # in a temporary folder
EVALUATION = EvaluationConfig(
    (SMALL,), ("follow_motion", "rotate", "twist"), ("L1", "L3", "L4"), 4, out=Path(RESULTS)
)


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


def you(page: Page) -> None:
    """An object that was clicked, before its place is."""
    page.choose("task", "visual_manipulation")
    page.fill("seed", "3")
    page.tab("You")
    page.wait_for("Click an")
    page.raw.wait_for_timeout(SETTLED_S * 1000)
    page.raw.mouse.click(*HEART_PX)
    page.wait_for("Now click its")


def browse(page: Page) -> None:
    """The evaluation of a policy, and its failures in one cell."""
    page.tab("Browse")
    page.fill("folder", RESULTS)
    page.wait_for("episodes failed")


SHOTS: dict[str, Callable[[Page], None]] = {
    "play": play,
    "why": why,
    "compare": compare,
    "compose": compose,
    "you": you,
    "browse": browse,
}


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
    here = Path(__file__).resolve()
    with (
        tempfile.TemporaryDirectory() as scratch,
        chdir(scratch),
        closing(Studio(StudioConfig())) as studio,
        launched_browser() as chromium,
    ):
        for name in sys.argv[1:] or SHOTS:
            if name == "browse":
                evaluate(EVALUATION)
            picture = take(SHOTS[name], studio.url, chromium)
            here.with_name(f"studio_{name}.png").write_bytes(picture)
