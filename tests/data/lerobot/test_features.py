"""What LeRobot policies get and give while acting is what the export contains."""

import numpy as np
import pytest

from openvima.data import Demonstration
from openvima.data.lerobot_frames import FrameLayout, action_from_row, frame_layout
from openvima.env import TabletopEnv
from openvima.errors import ActionError
from openvima.scene import END_EFFECTORS, Action
from openvima.scene.action import ToolCommand


@pytest.mark.parametrize("has_joints", [True, False])
def test_an_observation_is_encoded_as_the_frame_of_the_export(
    demos: list[Demonstration], has_joints: bool
) -> None:
    layout = FrameLayout(3, has_joints)
    for demo in demos:
        pictures, values = layout.pictures(demo), layout.values(demo)
        for step in range(demo.num_steps):
            observation = {
                "rgb": {view: images[step] for view, images in demo.rgb.items()},
                "joints": demo.joint_paths[step][0],
                "ee": END_EFFECTORS.index(demo.end_effector),
            }
            frame = layout.frame(observation, demo.prompt)
            np.testing.assert_array_equal(frame["agent_pos"], values["observation.state"][step])
            assert [f"observation.images.{name}" for name in frame["pixels"]] == list(layout.video_keys)
            for key, images in pictures.items():
                shown = frame["pixels"][key.rpartition(".")[2]]
                np.testing.assert_array_equal(np.moveaxis(shown, -1, 0), images[min(step, len(images) - 1)])
            row = values["action"][step]
            for key, array in demo.actions[step].to_arrays().items():
                np.testing.assert_allclose(action_from_row(row)[key], array, atol=1e-6)


def test_an_environment_observes_what_an_export_contains() -> None:
    env = TabletopEnv("rotate", domain="user", modalities=("rgb", "joints"))
    observation, _ = env.reset(seed=1)
    frame = FrameLayout(1, True).frame(observation, env.prompt)
    np.testing.assert_array_equal(frame["agent_pos"], [*env.joints, 0])
    assert frame["pixels"]["prompt_0_top"].shape == (128, 256, 3)


def test_a_row_beyond_the_bounds_is_brought_back_and_one_that_is_none_is_refused() -> None:
    row = np.array([0.9, -0.7, 0, 0, 3, 4, 0.5, 0.1, 0, 0, 0, 0], np.float32)
    action = Action.from_arrays(action_from_row(row))
    assert action.pose0_position == (0.75, -0.5)
    assert action.pose0_rotation == pytest.approx((0, 0, 0.6, 0.8))
    for bad in (np.nan, np.inf):
        row[0] = bad
        with pytest.raises(ActionError, match="must be finite"):
            Action.from_arrays(action_from_row(row))
    with pytest.raises(ActionError, match=r"shape \(11,\)"):
        action_from_row(row[:11])
    with pytest.raises(ActionError, match="dtype int64; it must be 12 floating-point numbers"):
        action_from_row(np.zeros(12, np.int64))


def test_a_row_of_commands_is_one_for_the_environment() -> None:
    layout = frame_layout("end_effector", 0, True)
    assert layout.action_names == ("dx", "dy", "dz", "dyaw", "tool")
    row = np.array([0.5, 0, 0, 0, 0.7], np.float64)
    assert ToolCommand.from_array(layout.action(row)).dx == pytest.approx(0.05)
    for bad in (row[:4], row.astype(int), np.zeros((1, 5))):
        with pytest.raises(ActionError, match="5 floating-point numbers: dx, dy, dz, dyaw, tool"):
            layout.action(bad)
    assert frame_layout("primitives", 0, False).state_names == ("end_effector",)
