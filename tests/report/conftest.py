"""Made-up results, prompts and clips, and a browser."""

from collections.abc import Iterator
from typing import Any

import pytest

from small_data_sets import clip, prompt, results
from studio_page import browser_or_skip

__all__ = ["clip", "prompt", "results"]


@pytest.fixture
def browser() -> Iterator[Any]:
    """The system's Chromium."""
    yield from browser_or_skip()
