"""The studio in a real browser: episodes played and explained, clicks, own scenes, failures played again."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openvima import training
from openvima.cli import quickstart
from openvima.data import Dataset, GenerateConfig, generate
from openvima.evaluation import EvaluationConfig, evaluate
from openvima.evaluation.evaluated_episode import evaluated_episode
from openvima.scene import Pose
from openvima.tasks import sample_episode

pytestmark = pytest.mark.slow

TASKS = ("rotate", "visual_manipulation")
NO_POLICY = "no_such_policy"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results")
    evaluate(EvaluationConfig(("random",), TASKS, ("L1", "L2"), episodes=2, out=out))
    return out


@pytest.fixture(scope="module")
def first_results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `openvima quickstart` writes, after a training of two steps."""

    def train_briefly(config: training.TrainingConfig, report: Any) -> Path:
        changes = {
            "schedule": replace(config.schedule, steps=2),
            "loader": replace(config.loader, batch_size=4),
            "pretraining": replace(config.pretraining, steps=0),
        }
        return train(replace(config, **changes), report)

    out, train = tmp_path_factory.mktemp("first") / "quickstart", training.train
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "train", train_briefly)
        patch.setattr(quickstart, "TASKS", ("visual_manipulation",))
        patch.setattr(quickstart, "LEVELS", ("L3",))
        patch.setattr(quickstart, "BASELINES", ("oracle",))
        quickstart.main(out=out, demonstrations=4, episodes=2, workers=1)
    return out


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demonstrations") / "mine"


@pytest.fixture(scope="module")
def studio(browser: Any, open_studio: Callable, results: Path, recorded: Path) -> Any:
    return open_studio(path=results, record=recorded)


@pytest.fixture(scope="module")
def plain_studio(browser: Any, open_studio: Callable) -> Any:
    return open_studio()


@pytest.fixture
def page(studio: Any, open_page: Callable) -> Any:
    opened = open_page(studio.url)
    opened.raw.set_viewport_size({"width": 1200, "height": 800})  # so that the prompt covers no object
    opened.wait_for("Success in % by task and level")  # which is opened last
    return opened


def newest(studio: Any) -> Any:
    """Return the session of the browser that came last."""
    return studio.sessions[max(studio.sessions)]


def settle(session: Any) -> None:
    session.submit(lambda: None).result()


def first_pose(session: Any) -> Pose:
    """Return the pose of the first object, read between the work of the session's thread."""
    read: list[Pose] = []
    session.submit(lambda: read.append(session.current.scene.placements[0].pose)).result()
    return read[0]


def pixel_of(page: Any, session: Any, position: tuple[float, float, float]) -> tuple[float, float]:
    """Return where a point of the world is in view."""
    camera = session.client.camera
    w, x, y, z = camera.wxyz.tolist()
    seen = (Pose(tuple(camera.position.tolist()), (x, y, z, w)).inverse() @ Pose(position)).position
    box = page.raw.locator("canvas").first.bounding_box()
    scale = box["height"] / 2 / math.tan(camera.fov / 2) / seen[2]
    left = box["x"] + box["width"] / 2 + scale * seen[0]
    return left, box["y"] + box["height"] / 2 + scale * seen[1]


def click(page: Any, session: Any, position: tuple[float, float, float]) -> None:
    """Click where a point of the world is in view."""
    page.raw.mouse.click(*pixel_of(page, session, position))


def drag(page: Any, session: Any, *points: tuple[float, float, float]) -> None:
    """Drag from the first point of the world over the others to the last."""
    first, *others = (pixel_of(page, session, point) for point in points)
    page.raw.mouse.move(*first)
    page.raw.wait_for_timeout(1000)  # until what is below the pointer is drawn as such
    page.raw.mouse.down()
    for each in others:
        page.raw.mouse.move(*each, steps=4)
    page.raw.mouse.up()


def drag_until(
    page: Any, session: Any, condition: Callable[[], bool], *points: tuple[float, float, float]
) -> None:
    """Drag again until something has come of it: a slow page misses drags."""
    for _ in range(20):
        drag(page, session, *points)
        for _ in range(50):
            if condition():
                return
            page.raw.wait_for_timeout(100)
    raise TimeoutError("nothing came of dragging")


def wait_until(page: Any, condition: Callable[[], bool]) -> None:
    for _ in range(1200):
        if condition():
            return
        page.raw.wait_for_timeout(100)
    raise TimeoutError("the page did not come to what was asked of it")


def test_clicks_solve_an_episode_and_the_success_is_recorded(page: Any, studio: Any, recorded: Path) -> None:
    session = newest(studio)
    session.submit(lambda: session.open(sample_episode("visual_manipulation", seed=3), None)).result()
    (goal,) = session.current.episode.problem.goals
    page.tab("You")
    page.wait_for("What you solve without a policy is recorded")
    click(page, session, session.current.scene[goal.object_id].pose.position)
    page.wait_for("Now click its")
    click(page, session, session.current.scene[goal.relative_to].pose.position)
    page.wait_for("1 demonstration in")
    assert session.current.outcome.success
    assert Dataset(recorded)[0].seed == 3


def test_nothing_of_an_evaluation_level_is_recorded(page: Any, studio: Any, recorded: Path) -> None:
    session = newest(studio)
    episode = sample_episode("visual_manipulation", level="L2", seed=3)
    session.submit(lambda: session.open(episode, None)).result()
    page.tab("You")
    page.wait_for("stays unseen; demonstrations are recorded at level train")


def test_a_scene_of_two_objects_is_composed_and_solved(page: Any, studio: Any, tmp_path: Path) -> None:
    session = newest(studio)
    page.tab("Compose")
    page.press("new scene")
    wait_until(page, lambda: session.editing)
    settle(session)
    prompt = session.current.episode.problem.prompt
    assert prompt.text == "Put the {a} into the {b}."
    block = session.current.scene.placements[0]
    click(page, session, block.pose.position)
    wait_until(page, lambda: page.raw.get_by_label("selected", exact=True).first.input_value() == "a")
    page.raw.get_by_text("File", exact=True).click()
    page.fill("file", str(tmp_path / "scene.yaml"))
    page.press("save")
    page.wait_for("Saved")
    page.raw.get_by_role("button", name="play", exact=True).last.click()
    wait_until(page, lambda: session.current.outcome is not None)
    settle(session)
    assert session.current.outcome.success and not session.editing
    actions = [step.action for step in session.current.steps]
    from openvima import load_episode, play

    again = play(load_episode(tmp_path / "scene.yaml"), "openvima-small")
    assert again.outcome.success and list(again.actions) == actions


def test_an_impossible_move_is_refused(page: Any, studio: Any) -> None:
    session = newest(studio)
    page.tab("Compose")
    page.press("new scene")
    wait_until(page, lambda: session.editing)
    settle(session)
    block, bowl = session.current.scene.placements
    click(page, session, block.pose.position)
    wait_until(page, lambda: page.raw.get_by_label("selected", exact=True).first.input_value() == "a")
    inputs = page.raw.get_by_text("x, y (m)").locator("xpath=../../..").locator("input")
    inputs.nth(1).fill(f"{bowl.pose.y:.2f}")
    inputs.nth(1).press("Enter")
    page.wait_for("overlaps object")
    assert first_pose(session) == block.pose


def test_objects_are_dragged_over_the_table_but_not_into_others(page: Any, studio: Any) -> None:
    session = newest(studio)
    page.tab("Compose")
    page.press("new scene")
    wait_until(page, lambda: session.editing)
    settle(session)
    before, bowl = session.current.scene.placements
    (x, y, z) = before.pose.position
    away = -0.15 if bowl.pose.y > y else 0.15  # from the bowl
    drag_until(page, session, lambda: first_pose(session) != before.pose, (x, y, z), (x, y + away, z))
    moved = first_pose(session)
    assert abs(moved.y - y - away) < 0.03 and abs(moved.x - x) < 0.03
    assert moved.z == z and round(moved.y, 3) == moved.y  # at its rest height, in whole millimetres
    refusal = page.raw.get_by_text("overlaps object").first
    drag_until(page, session, refusal.is_visible, (moved.x, moved.y, z), (bowl.pose.x, bowl.pose.y, z))
    assert first_pose(session) == moved
    assert tuple(session.table.objects[before.id].position) == moved.position  # as shown


def test_a_failure_of_a_results_folder_is_played_again(page: Any, studio: Any) -> None:
    session = newest(studio)
    page.raw.get_by_role("button", name="L2 0", exact=True).first.click()
    page.wait_for("rotate, L2")
    page.press("live")
    wait_until(page, lambda: session.current.episode.domain == "eval" and session.current.outcome is not None)
    episode = session.current.episode
    assert (episode.task, episode.level, episode.seed) == ("rotate", "L2", 0)
    assert not session.current.outcome.success


def test_a_failure_of_the_first_command_is_played_again_by_the_policy_trained_there(
    page: Any, studio: Any, first_results: Path
) -> None:
    session = newest(studio)
    page.tab("Browse")
    page.fill("folder", str(first_results))
    page.wait_for("visual_manipulation, L3")
    page.press("live")
    wait_until(page, lambda: session.current.episode.domain == "eval" and session.current.outcome is not None)
    recorded = evaluated_episode(first_results, "trained", "visual_manipulation", "L3", 0)
    assert session.current.outcome.reason == recorded.outcome.reason and not recorded.outcome.success
    steps = session.current.steps
    actions = [np.concatenate([*step.action.to_arrays().values()]) for step in steps]
    assert np.allclose(actions, recorded.actions, atol=1e-6)
    assert all(step.proposal.explanation is not None for step in steps)


def test_demonstrations_are_found_and_scrubbed(page: Any, studio: Any, tmp_path: Path) -> None:
    demos = generate(GenerateConfig(out=tmp_path / "demos", tasks=("rotate",), episodes=1))
    session = newest(studio)
    page.tab("Browse")
    page.fill("folder", str(demos))
    page.wait_for("1 of 1 found")
    page.wait_for("step 0 of 1")
    slider = (
        page.raw.get_by_text("after step", exact=True)
        .last.locator("xpath=../../..")
        .locator("input[type=text]")
    )
    slider.fill("1")
    slider.press("Enter")
    page.wait_for("step 1 of 1")
    settle(session)
    demo = Dataset(demos)[0]
    assert np.array_equal(session.table.shown.joints, demo.joint_paths[0][-1])


def test_an_episode_is_played_to_success_taken_back_and_explained(
    plain_studio: Any, open_page: Callable
) -> None:
    page = open_page(plain_studio.url)
    page.wait_for("0 steps of at most")
    page.press("play")
    page.wait_for("solved in")
    session = newest(plain_studio)
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


def test_what_fails_is_said_and_the_page_lives_on(plain_studio: Any, open_page: Callable) -> None:
    page = open_page(plain_studio.url)
    page.wait_for("0 steps of at most")
    page.choose("policy", "other …")
    page.fill("source", NO_POLICY)
    page.wait_for(f"there is no policy '{NO_POLICY}'")
    page.choose("policy", "oracle")
    page.press("play")
    page.wait_for("solved in")


def test_two_browsers_have_sessions_of_their_own(plain_studio: Any, open_page: Callable) -> None:
    first = open_page(plain_studio.url)
    first.wait_for("0 steps of at most")
    one = newest(plain_studio)
    second = open_page(plain_studio.url)
    second.wait_for("0 steps of at most")
    other = newest(plain_studio)
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
