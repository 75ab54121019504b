"""What observations hold on request: depth against geometry, joints against the arm, and what is refused."""

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.env.tabletop import MODALITIES
from openvima.errors import ConfigError, ShapeError
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.render import CAMERAS, VIEWS, Rasteriser, points_from_depth, project
from openvima.scene import Action, Placement, Pose, Scene
from openvima.sim.ur5 import HOME
from sim_cases import BoxAssets

HALF_ULP_M = 2**-14  # of float32 between 1024 and 2048, where distances lie


@pytest.mark.parametrize("view", VIEWS)
def test_depth_is_the_distance_of_the_surface_from_the_camera_plane(view) -> None:
    block = Placement(5, "block", "red", (0.07, 0.07, 0.07), Pose.planar(0.5, 0.1, 0.3, z=0.034))
    image = Rasteriser(BoxAssets()).scene(Scene((block,)), views=(view,), depth=True)[view]
    camera = CAMERAS[view]
    assert image.depth is not None and image.depth.dtype == np.float32 and np.isfinite(image.depth).all()
    for point, height in (((0.5, 0.1), 0.069), ((0.45, -0.2), 0.0)):  # the block's top, and the table
        x, y, z, rest = camera.away
        column, row = np.rint(project(np.array([*point, height]), camera)).astype(int)
        found = points_from_depth(image.depth, camera)[row, column]
        np.testing.assert_allclose(found[2], height, atol=2 * HALF_ULP_M)
        np.testing.assert_allclose(found[:2], point, atol=0.004)  # the pixel samples a point near by
        np.testing.assert_allclose(
            image.depth[row, column], found @ (x, y, z) + rest, rtol=0, atol=2 * HALF_ULP_M
        )


@pytest.mark.parametrize("view", VIEWS)
def test_points_of_a_depth_image_lie_on_the_pixels_they_come_from(view) -> None:
    rng = np.random.default_rng(0)
    depth = CAMERAS[view].away[3] - rng.uniform(0, 0.3, (128, 256))
    pixels = project(points_from_depth(depth, CAMERAS[view]), CAMERAS[view])
    np.testing.assert_allclose(pixels, np.indices((128, 256))[::-1].transpose(1, 2, 0), atol=1e-6)
    assert np.isnan(points_from_depth(np.full((128, 256), np.inf), CAMERAS[view])).all()
    with pytest.raises(ShapeError, match="64"):
        points_from_depth(depth[:64], CAMERAS[view])


def test_an_observation_holds_what_was_asked_for() -> None:
    every, plain = TabletopEnv("rotate", modalities=MODALITIES), TabletopEnv("rotate")
    seen, info = every.reset(seed=3)
    default, _ = plain.reset(seed=3)
    assert list(default) == ["rgb", "segm", "ee"] and list(seen) == [*MODALITIES, "ee"]
    assert every.observation_space.contains(seen) and plain.observation_space.contains(default)
    for view in VIEWS:
        assert seen["rgb"][view].tobytes() == default["rgb"][view].tobytes()
        assert seen["depth"][view].shape == (128, 256) and seen["depth"][view].dtype == np.float32
    assert info["joints"].tobytes() == seen["joints"].tobytes() == HOME.astype(np.float32).tobytes()
    depth_alone = TabletopEnv("rotate", modalities=("depth",))
    assert list(depth_alone.reset(seed=3)[0]) == ["depth", "ee"]
    for wrong, complaint in ((("rgb", "depht"), "depth"), ("lidar", "lidar")):
        with pytest.raises(ConfigError, match=complaint):
            TabletopEnv("rotate", modalities=wrong)


def test_joints_are_where_the_path_of_the_last_step_ended() -> None:
    env = TabletopEnv("visual_manipulation", modalities=("joints",))
    env.reset(seed=0)
    seen, *_, info = env.step(Action.planar((0.4, 0.1), (0.6, -0.2)))
    assert env.observation_space.contains(seen)
    assert env.joints.tobytes() == info["joints"].tobytes() == env.joint_path[-1].tobytes()
    assert not np.array_equal(env.joint_path[0], env.joints)


class Noting:
    """Notes what it sees, and moves nothing."""

    modalities = ("joints", "depth")

    def reset(self, prompts):
        self.seen = []

    def act(self, observations):
        self.seen += [set(each) for each in observations if each is not None]
        return [Action.planar((0.25, -0.5), (0.25, -0.5)).to_arrays() for _ in observations]


def test_an_evaluated_policy_sees_what_it_declares() -> None:
    noting = Noting()
    play([TabletopEnv("rotate")], [0], PromptedRolloutPolicy(noting))
    assert noting.seen and all(seen == {"joints", "depth", "ee"} for seen in noting.seen)
