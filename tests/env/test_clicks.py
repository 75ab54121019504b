"""Clicks become the actions that a user means."""

import math

import pytest

import openvima
from openvima.catalog import load_assets
from openvima.env import TabletopEnv
from openvima.errors import SceneError
from openvima.render.raycast import Hit, first_hit
from openvima.scene import Scene
from openvima.scene.action import pose_after
from openvima.studio.browser_session import clicked_action
from openvima.tasks import sample_episode


def click(scene: Scene, x: float, y: float) -> Hit:
    hit = first_hit(scene, (x + 0.3, y, 0.5), (-0.3, 0.0, -0.5), load_assets("procedural"))
    assert hit is not None
    return hit


def test_clicks_solve_visual_manipulation_and_the_preview_is_where_the_object_ends() -> None:
    env = TabletopEnv("visual_manipulation")
    env.reset(seed=3)
    (goal,), scene = env.episode.problem.goals, env.scene
    target, base = scene[goal.object_id], scene[goal.relative_to]
    first = click(scene, target.pose.x, target.pose.y)
    action = clicked_action(scene, first, click(scene, base.pose.x, base.pose.y), turn_rad=math.radians(30))
    assert first.object_id == target.id
    expected = pose_after(target.pose, action)
    assert expected.yaw_rad == pytest.approx(target.pose.yaw_rad + math.radians(30), abs=1e-6)
    env.step(action)
    assert env.outcome.success
    assert env.scene[target.id].pose.planar_distance(expected) < 0.02  # it settles in its base


def test_a_block_that_is_clicked_is_swept_from_behind() -> None:
    objects = [("small block", "red", (0.5, 0.1)), ("three-sided rectangle", "blue", (0.5, -0.2))]
    goals = [("swept_into", "a", "b")]
    episode = openvima.compose(objects, "Sweep {a}.", goals=goals, end_effector="spatula")
    env = TabletopEnv("rotate")
    env.reset(options={"episode": episode})
    action = clicked_action(env.scene, click(env.scene, 0.5, 0.1), Hit(0, (0.5, -0.23, 0.0)))
    assert action.pose0_position == pytest.approx((0.5, 0.106))
    env.step(action)
    assert env.outcome.success
    beside = clicked_action(env.scene, Hit(0, (0.4, 0.1, 0.0)), Hit(0, (0.4, -0.1, 0.0)))
    assert beside.pose0_position == pytest.approx((0.4, 0.1))


def test_what_cannot_be_picked_is_said() -> None:
    scene = sample_episode("visual_manipulation", seed=3).problem.scene
    fixed = next(p for p in scene.placements if p.fixed)
    with pytest.raises(SceneError, match="no object at"):
        clicked_action(scene, Hit(0, (0.3, 0.4, 0.0)), Hit(0, (0.5, 0.0, 0.0)))
    with pytest.raises(SceneError, match="is fixed to the table"):
        clicked_action(scene, Hit(fixed.id, (0.3, 0.4, 0.0)), Hit(0, (0.5, 0.0, 0.0)))
