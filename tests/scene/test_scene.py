"""Scenes, poses, prompts, goals and actions."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from openvima.errors import ActionError, PromptError, SceneError
from openvima.scene import (
    Action,
    AtPose,
    InZone,
    NeverTouches,
    ObjectImage,
    Placement,
    Pose,
    Prompt,
    PromptImage,
    RenderedPrompt,
    Scene,
    Tolerance,
    Zone,
    angle_difference,
    block_points,
    in_workspace,
)
from openvima.scene.explanation import Explanation, ObjectProbability, PlaceProbability
from openvima.scene.scene import normalised
from strategies import angles, flat_poses, poses


def placed(object_id: int, x: float = 0.5) -> Placement:
    return Placement(object_id, "block", "red", (0.07, 0.07, 0.07), Pose.planar(x, 0.0))


def test_an_object_is_found_by_its_id() -> None:
    scene = Scene((placed(5), placed(7, 0.6)))
    assert scene[7].pose.x == 0.6
    with pytest.raises(SceneError, match=r"id 6.*\[5, 7\]"):
        scene[6]


@pytest.mark.parametrize("ids", [(5, 5), (6, 5)])
def test_ids_must_be_distinct_and_ascending(ids: tuple[int, int]) -> None:
    with pytest.raises(SceneError, match="distinct and ascending"):
        Scene(tuple(placed(object_id) for object_id in ids))


def test_moving_one_object_leaves_the_others_and_the_old_scene_alone() -> None:
    scene = Scene((placed(5), placed(6)))
    moved = scene.with_poses({6: Pose.planar(0.3, 0.1)})
    assert (moved[5], moved[6].pose.x, scene[6].pose.x) == (scene[5], 0.3, 0.5)


@pytest.mark.parametrize(
    ("x", "y", "inside"), [(0.25, 0.5, True), (0.75, -0.5, True), (0.2499, 0.0, False), (0.5, 0.5001, False)]
)
def test_the_workspace_includes_its_border(x: float, y: float, inside: bool) -> None:
    assert in_workspace(Pose.planar(x, y)) is inside


def assert_close(a: Pose, b: Pose) -> None:
    np.testing.assert_allclose(a.position, b.position, atol=1e-9)
    np.testing.assert_allclose(a.matrix(), b.matrix(), atol=1e-9)  # q and −q are the same rotation


@given(poses)
def test_a_pose_times_its_inverse_is_the_identity(pose: Pose) -> None:
    assert_close(pose @ pose.inverse(), Pose((0.0, 0.0, 0.0)))
    assert_close(pose.inverse() @ pose, Pose((0.0, 0.0, 0.0)))


@given(flat_poses, angles)
def test_turning_on_the_spot_adds_to_the_heading_and_keeps_the_place(pose: Pose, turn: float) -> None:
    turned = pose.rotated(turn)
    assert turned.position == pose.position
    assert angle_difference(turned.yaw_rad, pose.yaw_rad + turn) < 1e-9


def test_the_heading_is_counter_clockwise_seen_from_above() -> None:
    x_axis = Pose.planar(0, 0, math.pi / 2).transform(np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(x_axis, [0, 1, 0], atol=1e-12)


def test_the_heading_of_a_tilted_body_is_that_of_the_static_zxy_angles() -> None:
    # R = Ry(0.3) Rx(-0.2) Rz(0.7), written out by hand.
    about_y = Pose((0, 0, 0), (0.0, math.sin(0.15), 0.0, math.cos(0.15)))
    about_x = Pose((0, 0, 0), (math.sin(-0.1), 0.0, 0.0, math.cos(-0.1)))
    assert (about_y @ about_x @ Pose.planar(0, 0, 0.7)).yaw_rad == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("a_deg", "b_deg", "period_deg", "expected_deg"),
    [
        (0, 350, 360, 10),
        (-179, 179, 360, 2),
        (0, 80, 90, 10),
        (10, 130, 120, 0),
        (0, 77, 0, 0),
    ],
)
def test_angles_differ_by_the_shorter_way_round(
    a_deg: float, b_deg: float, period_deg: float, expected_deg: float
) -> None:
    difference = angle_difference(*(math.radians(v) for v in (a_deg, b_deg, period_deg)))
    assert math.degrees(difference) == pytest.approx(expected_deg, abs=1e-9)


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (math.inf, 0, 0, 1)])
def test_a_quaternion_without_direction_is_refused(quaternion: tuple[float, float, float, float]) -> None:
    with pytest.raises(SceneError, match="no direction"):
        normalised(quaternion)


IMAGE = ObjectImage(Placement(5, "block", "red", (0.07, 0.07, 0.07), Pose.planar(0.5, 0.0)))


def rendered(name: str) -> PromptImage:
    nothing = np.zeros((3, 128, 256), np.uint8)
    return PromptImage(name, "object", {"top": nothing}, {"top": nothing[0]}, ())


def test_words_and_numbers_enter_the_text_and_images_keep_their_place() -> None:
    prompt = Prompt.parse("Put {det} {b} into {a}, {angle} times.", det="any", angle=3, a=IMAGE, b=IMAGE)
    assert prompt.text == "Put any {b} into {a}, 3 times."
    assert [name for name, _ in prompt.images] == ["b", "a"]  # in reading order


@pytest.mark.parametrize("fills", [{}, {"a": IMAGE, "b": IMAGE}])
def test_slots_and_fills_must_be_the_same(fills: dict[str, ObjectImage]) -> None:
    with pytest.raises(PromptError, match="slots"):
        Prompt.parse("Look at {a}.", **fills)


def test_a_rendered_prompt_reads_as_an_interleaved_sequence() -> None:
    a, b = rendered("a"), rendered("b")
    prompt = RenderedPrompt("Put the {a} into the {b}.", {"a": a, "b": b})
    assert prompt.sequence() == ["Put the", a, "into the", b, "."]


BLOCK_SIZE = (0.03, 0.03, 0.03)


def scene_with_block(pose: Pose) -> Scene:
    return Scene((Placement(4, "small block", "red", BLOCK_SIZE, pose),), "spatula")


@pytest.mark.parametrize(("distance", "met"), [(0.0999, True), (0.1, False)])
def test_the_position_tolerance_is_strict_at_any_height(distance: float, met: bool) -> None:
    assert Tolerance(position_m=0.1).accepts(Pose.planar(distance, 0.0, z=0.5), Pose.planar(0.0, 0.0)) is met


@pytest.mark.parametrize(("error_deg", "met"), [(14.5, True), (-14.5, True), (15.5, False)])
def test_the_yaw_tolerance_holds_across_the_wrap(error_deg: float, met: bool) -> None:
    tolerance = Tolerance(position_m=0.1, yaw_rad=math.radians(15))
    target = Pose.planar(0, 0, math.radians(178))
    assert tolerance.accepts(target.rotated(math.radians(error_deg)), target) is met


def test_symmetric_shapes_match_at_any_of_their_headings() -> None:
    goal = AtPose(4, Pose.planar(0.5, 0), Tolerance(0.1, math.radians(15)), symmetry_rad=math.pi / 2)
    assert goal.is_met(scene_with_block(Pose.planar(0.5, 0, math.radians(80))))
    assert not goal.is_met(scene_with_block(Pose.planar(0.5, 0, math.radians(45))))


def test_a_block_is_eight_points_that_miss_its_upper_edges() -> None:
    points = block_points(Pose.planar(0.5, 0.1, z=0.014))
    assert len(points) == 8
    assert min(x for x, _, _ in points) == pytest.approx(0.485)
    assert max(x for x, _, _ in points) == pytest.approx(0.505)
    assert max(z for _, _, z in points) == pytest.approx(0.019)


@pytest.mark.parametrize(("x", "inside"), [(0.5451, False), (0.5449, True), (0.4651, True), (0.4649, False)])
def test_a_block_is_in_a_zone_only_with_all_its_points_and_touches_it_with_one(
    x: float, inside: bool
) -> None:
    zone = Zone(0.5, 0.0, 0.1, 0.1)  # x from 0.45 to 0.55; points from x − 0.015 to x + 0.005
    assert InZone(4, zone).is_met(scene_with_block(Pose.planar(x, 0.0))) is inside
    assert not NeverTouches((4,), zone, "line").is_met(scene_with_block(Pose.planar(x, 0.0)))
    beside = scene_with_block(Pose.planar(0.5651, 0.0))
    assert NeverTouches((4,), zone, "line").is_met(beside)
    assert zone.contains((0.5, 0.0, 0.299)) and not zone.contains((0.5, 0.0, 0.3))


def explained(picks: list[float], places: list[tuple[float, float]]) -> Explanation:
    """Build an explanation of pick probabilities and of pairs of x and probability of places."""
    return Explanation(
        {},
        (),
        {},
        tuple(ObjectProbability(number, {}, (0.5, 0.0), p) for number, p in enumerate(picks)),
        tuple(PlaceProbability("grid", (x, 0.0), p) for x, p in places),
    )


def test_candidates_at_one_place_count_together() -> None:
    places = explained([1.0], [(0.3, 0.3), (0.5, 0.4), (0.31, 0.3)]).distinct_places()
    assert [round(place.probability, 6) for place in places] == [0.6, 0.4]
    assert places[0].position == (0.3, 0.0)
    at_start, in_view = (
        PlaceProbability(k, (0.3, 0.0), p) for k, p in (("first step", 0.7), ("in view", 0.3))
    )
    (place,) = replace(explained([1.0], []), places=(at_start, in_view)).distinct_places()
    assert (place.kind, place.probability) == ("in view", 1.0)


def arrays(**changes: object) -> dict[str, Any]:
    action: dict[str, Any] = {
        "pose0_position": np.array([0.4, 0.1], np.float32),
        "pose0_rotation": np.array([0, 0, 0, 1], np.float32),
        "pose1_position": np.array([0.6, -0.2], np.float32),
        "pose1_rotation": np.array([0, 0, 0, 1], np.float32),
    }
    return action | changes


@given(angles)
def test_arrays_and_actions_convert_into_one_another(yaw: float) -> None:
    action = Action.planar((0.4, 0.1), (0.6, -0.2), yaw)
    assert Action.from_arrays(action.to_arrays()) == action
    assert math.isclose(math.remainder(action.yaw1_rad - yaw, 2 * math.pi), 0.0, abs_tol=1e-6)
    assert action.yaw0_rad == 0.0


def test_planar_actions_stay_in_the_workspace() -> None:
    action = Action.planar((0.0, -3.0), (1.0, 0.7))
    assert action.pose0_position == (0.25, -0.5)
    assert action.pose1_position == (0.75, 0.5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pose0_position": np.float32([0.8, 0.1])}, r"pose0_position is \(0.8, 0.1\); x must lie in 0.25"),
        ({"pose1_position": np.float32([0.5, -0.6])}, r"pose1_position is .* y in -0.5 … 0.5 m"),
        ({"pose1_position": np.float32([math.nan, 0])}, "pose1_position .* finite"),
        ({"pose0_position": np.array([1e300, 0.0])}, "must be finite"),
        ({"pose1_position": np.zeros(3, np.float32)}, r"pose1_position is .* shape \(3,\) .* must be 2"),
        ({"pose0_position": np.float32(0.5)}, r"pose0_position is .* of shape \(\)"),
        ({"pose0_rotation": np.array([0, 0, 0, 1])}, "dtype int64; it must be 4 floating-point"),
        ({"pose1_position": np.complex64([0.5, 0])}, "pose1_position is .*dtype complex64"),
        ({"pose0_rotation": None}, "pose0_rotation is a NoneType of .*dtype object"),
        ({"pose0_rotation": np.float32([0, 0, 0, 1.5])}, r"pose0_rotation is .*must lie in -1 … 1"),
        (
            {"pose0_position": [0.5, [0.1, 0.2]]},
            "is a list of .* must be 2 floating-point numbers",
        ),
        ({"pose0_position": np.float32([9, 9]), "gripper": 1.0}, "unknown keys gripper.*pose0_position is"),
    ],
)
def test_an_action_that_cannot_be_is_refused_with_the_reason(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ActionError, match=message):
        Action.from_arrays(arrays(**changes))


def test_all_problems_of_an_action_are_told_at_once() -> None:
    action = arrays(pose0_position=np.array([9.0, 0.0], np.float32))
    del action["pose1_rotation"]
    with pytest.raises(ActionError, match=r"pose1_rotation missing.*pose0_position.*Nothing was moved"):
        Action.from_arrays(action)
    for wrong in (None, 3):
        with pytest.raises(ActionError, match=f"a mapping with keys .* not {type(wrong).__name__}"):
            Action.from_arrays(wrong)  # type: ignore[arg-type]


def test_double_precision_and_a_zero_quaternion_are_taken_too() -> None:
    action = Action.from_arrays(arrays(pose0_position=np.array([0.3, 0.2]), pose1_rotation=np.zeros(4)))
    assert action.pose0_position[0] == np.float32(0.3) and action.yaw1_rad == 0.0


def test_only_the_heading_of_a_tilted_tool_matters() -> None:
    half = math.sqrt(0.5)
    tilted = np.array([0.1, 0.0, half, half], np.float32)
    yaw = Action.from_arrays(arrays(pose1_rotation=tilted)).yaw1_rad
    assert math.degrees(yaw) == pytest.approx(90, abs=10)
