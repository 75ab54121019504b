"""Made-up results, prompts and clips, and a browser."""

from collections.abc import Iterator
from typing import Any

import pytest

from made_up_results import clip, prompt, results
from studio_page import BROWSERS, find_browser, launched_browser

__all__ = ["clip", "prompt", "results"]


@pytest.fixture
def browser() -> Iterator[Any]:  # Any: playwright may be missing
    """The system's Chromium."""
    pytest.importorskip("playwright.sync_api", reason="playwright drives the browser")
    if find_browser() is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is installed")
    with launched_browser() as launched:
        yield launched
