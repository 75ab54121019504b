"""Pages that begin with an example quote it as it stands."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = {
    "compose": "compose_a_scene",
    "explain": "explain_a_decision",
    "observations": "joints_and_depth",
    "prompts": "language_prompts",
    "your_own_objects": "custom_object",
    "your_own_policy": "score_my_policy",
    "your_own_task": "custom_task",
    "your_own_training": "own_training_loop",
}


@pytest.mark.parametrize(("page", "example"), PAGES.items())
def test_the_page_begins_with_its_example(page: str, example: str) -> None:
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    code = (ROOT / "examples" / f"{example}.py").read_text(encoding="utf-8")
    assert len(code.splitlines()) <= 45
    assert text.split("```")[1] == f"python\n{code}"
