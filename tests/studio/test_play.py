"""Play and Why in a real browser: episodes, explanations, comparison, several browsers, errors."""

from collections.abc import Callable
from typing import Any

import pytest

pytestmark = pytest.mark.slow

NO_POLICY = "no_such_policy"


@pytest.fixture(scope="module")
def studio(browser: Any, open_studio: Callable[..., Any]) -> Any:
    return open_studio()


def newest(studio: Any) -> Any:
    """Return the session of the browser that came last."""
    return studio.sessions[max(studio.sessions)]


def test_an_episode_is_played_to_success_taken_back_and_explained(studio: Any, open_page: Callable) -> None:
    page = open_page(studio.url)
    page.wait_for("0 steps of at most")
    page.press("play")
    page.wait_for("solved in")
    session = newest(studio)
    session.submit(lambda: session.back(1)).result()
    page.wait_for("1 step of at most")
    page.tab("Why")
    page.check("show why")
    page.wait_for("probab")
    assert session.prompt_weights and session.current.propose().explanation is not None
    page.choose("compare with", "random")
    page.wait_for("No difference so far.")  # both begin anew
    page.tab("Play")
    page.press("step")
    page.wait_for("1 step of at most")
    page.tab("Why")
    page.wait_for("first difference")
    assert session.current.num_steps == session.compared.num_steps == 1


def test_what_fails_is_said_and_the_page_lives_on(studio: Any, open_page: Callable) -> None:
    page = open_page(studio.url)
    page.wait_for("0 steps of at most")
    page.choose("policy", "other …")
    page.fill("source", NO_POLICY)
    page.wait_for(f"there is no policy '{NO_POLICY}'")
    page.choose("policy", "oracle")
    page.press("play")
    page.wait_for("solved in")


def test_two_browsers_have_sessions_of_their_own(studio: Any, open_page: Callable) -> None:
    first = open_page(studio.url)
    first.wait_for("0 steps of at most")
    one = newest(studio)
    second = open_page(studio.url)
    second.wait_for("0 steps of at most")
    other = newest(studio)
    second.choose("task", "visual_manipulation")
    second.press("step")
    second.wait_for("solved in")
    assert other.current.num_steps == 1 and other.current.episode.task == "visual_manipulation"
    assert one.current.num_steps == 0 and one.current.episode.task == "rearrange"
    first.press_at_once("step", "pause")  # each counts, however fast
    first.wait_for("1 step of at most")


def test_pages_of_other_sites_show_nothing(browser: Any, open_studio: Callable, open_page: Callable) -> None:
    studio = open_studio()
    open_page(studio.url.replace("127.0.0.1", "elsewhere.localhost")).wait_for("No entry")
    assert not studio.sessions
