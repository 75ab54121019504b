"""Scenes hold objects by their ids."""

import pytest

from openvima.errors import SceneError
from openvima.scene import Placement, Pose, Scene, in_workspace


def placed(object_id: int, x: float = 0.5) -> Placement:
    return Placement(object_id, "block", "red", (0.07, 0.07, 0.07), Pose.planar(x, 0.0))


def test_an_object_is_found_by_its_id() -> None:
    assert Scene((placed(5), placed(7, 0.6)))[7].pose.x == 0.6


def test_an_unknown_id_is_named_together_with_those_that_exist() -> None:
    with pytest.raises(SceneError, match=r"id 6.*\[5, 7\]"):
        Scene((placed(5), placed(7)))[6]


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
