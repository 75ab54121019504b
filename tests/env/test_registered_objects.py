"""Objects of users in the simulator, in composed scenes and in text prompts."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from openvima import compose, make
from openvima.catalog import register_object
from openvima.scene import Action, AtPose, Scene, Tolerance
from openvima.tasks import register_task, registry, task_spec
from openvima.tasks.prompts import rewrite
from openvima.wrappers import ProgressReward
from user_shapes import boxes, restored_assets

TRAY = boxes(
    ((0, 0, 0), (20, 20, 1)),
    *(((0, 0, 1), (1, 20, 5)), ((19, 0, 1), (20, 20, 5))),
    *(((1, 0, 1), (19, 1, 5)), ((1, 19, 1), (19, 20, 5))),
)


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    size = (0.2, 0.2, 0.05)
    with restored_assets():
        register_object("test tray", TRAY, size=size, collision=TRAY, aliases=("salver",))
        register_object("test lid", TRAY, size=size)
        yield


class Inside(NamedTuple):
    """A goal without an object of its own."""

    moved: int
    base: int

    def is_met(self, scene: Scene) -> bool:
        return scene[self.moved].pose.planar_distance(scene[self.base].pose) < 0.05

    def oracle_move(self, scene: Scene) -> AtPose:
        return AtPose(self.moved, scene[self.base].pose, Tolerance(0.05))


def placed_height_m(container: str) -> float:
    objects = [
        ("block", "red", (0.5, -0.3)),
        {"object": container, "texture": "green", "position": (0.5, 0.2), "fixed": True},
    ]
    episode = compose(objects, "Put the {a} into the {b}.", goals=[Inside(5, 6)])
    assert [p.fixed for p in episode.problem.scene.placements] == [False, True]
    env = make("rotate")
    env.reset(options={"episode": episode})
    *_, info = env.step(env.oracle_decision().action)
    assert info["success"], info["reason"]
    return env.scene[5].pose.z


class NoNumber(Inside):
    """Its distance is no number."""

    def distance(self, scene: Scene) -> tuple[float, float]:
        return math.nan, 0.0


@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space")
@pytest.mark.parametrize("goal", [Inside, NoNumber, None])
def test_environments_whose_goals_state_no_distance_pass_the_checks_of_gymnasium(
    goal: type | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    objects = [("block", "red", (0.5, -0.3)), ("test tray", "green", (0.5, 0.2))]
    goals = [] if goal is None else [goal(5, 6)]
    problem = compose(objects, "Put the {a} into the {b}.", goals=goals).problem
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    pools = task_spec("rotate").pools
    register_task("own_goal", family="x", template="x.", oracle_max_steps=1, pools=pools)(
        lambda table: problem
    )
    env = make("own_goal")
    check_env(env, skip_render_check=True)
    _, info = env.reset(seed=0)
    assert info["progress"] == {"goals_met": 0.0, "distance_m": math.inf, "angle_rad": math.inf}
    rewards = ProgressReward(env)
    rewards.reset(seed=0)
    assert rewards.step(Action((0.3, 0.0), (0.3, 0.0)).to_arrays())[1] == 0.0


def test_objects_go_into_a_hollow_with_a_collision_mesh_and_rest_on_a_hull_without() -> None:
    half_block_m = 0.0343
    assert placed_height_m("test tray") == pytest.approx(0.01 + half_block_m, abs=0.004)
    assert placed_height_m("test lid") == pytest.approx(0.05 + half_block_m, abs=0.004)


def test_a_registered_object_has_its_aliases_in_text_prompts() -> None:
    problem = compose([("test tray", "green", (0.5, 0.2))], "Move the {a}.").problem
    texts = {
        rewrite(problem.prompt, problem.scene, "text,paraphrased", np.random.default_rng(seed)).text
        for seed in range(20)
    }
    assert texts == {"Move the green test tray.", "Move the green salver."}
