"""Actions are checked at the border."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given

from openvima.errors import ActionError
from openvima.scene import Action
from openvima.scene.action import is_valid_batch
from strategies import angles


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
        (
            {"pose0_position": np.array([0.8, 0.1], np.float32)},
            r"pose0_position is \(0.8, 0.1\); x must lie in",
        ),
        ({"pose1_position": np.array([math.nan, 0], np.float32)}, "pose1_position .* finite"),
        ({"pose1_position": np.zeros(3, np.float32)}, r"pose1_position has shape \(3,\)"),
        ({"pose0_rotation": np.array([0, 0, 0, 1])}, "pose0_rotation has dtype int64"),
        ({"pose0_rotation": np.array([0, 0, 0, 1.5], np.float32)}, "-1 … 1"),
        ({"gripper": 1.0}, "unknown keys gripper"),
        ({"pose0_position": [0.5, [0.1, 0.2]]}, "cannot convert; give 2 numbers"),
        ({"pose0_position": np.array([1e300, 0.0])}, "must be finite"),
    ],
)
def test_an_action_that_cannot_be_is_refused_with_the_reason(
    changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ActionError, match=message):
        Action.from_arrays(arrays(**changes))
    rows: dict[str, object] = {key: np.stack([value] * 2) for key, value in arrays().items()}
    for key, value in changes.items():
        rows[key] = np.stack([value] * 2) if isinstance(value, np.ndarray) else value
    assert not is_valid_batch(rows, 2)


def test_a_batch_is_valid_if_every_action_is() -> None:
    batch = {key: np.stack([value] * 3) for key, value in arrays().items()}
    assert is_valid_batch(batch, 3)
    assert is_valid_batch({key: rows.astype(np.float64) for key, rows in batch.items()}, 3)
    assert not is_valid_batch(batch, 2)
    assert not is_valid_batch({key: rows.tolist() for key, rows in batch.items()}, 3)


def test_all_problems_of_an_action_are_told_at_once() -> None:
    action = arrays(pose0_position=np.array([9.0, 0.0], np.float32))
    del action["pose1_rotation"]
    with pytest.raises(ActionError, match=r"pose1_rotation missing.*pose0_position.*Nothing was moved"):
        Action.from_arrays(action)


def test_double_precision_is_taken_too() -> None:
    assert Action.from_arrays(arrays(pose0_position=np.array([0.3, 0.2]))).pose0_position[0] == np.float32(
        0.3
    )


def test_a_zero_quaternion_counts_as_no_turn() -> None:
    action = Action.from_arrays(arrays(pose1_rotation=np.zeros(4, np.float32)))
    assert action.yaw1_rad == 0.0


def test_only_the_heading_of_a_tilted_tool_matters() -> None:
    half = math.sqrt(0.5)
    tilted = np.array([0.1, 0.0, half, half], np.float32)
    yaw = Action.from_arrays(arrays(pose1_rotation=tilted)).yaw1_rad
    assert math.degrees(yaw) == pytest.approx(90, abs=10)
