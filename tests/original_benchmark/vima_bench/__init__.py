"""A stand-in for the original benchmark, without physics: what its client in examples/ calls."""

import sys

import numpy as np

from vima_bench.env import base

assert np.bool8 is np.bool_  # the original needs it when it is imported

_ALL = {"rotate": {"possible_dragged_obj": ["letter R"]}, "twist": {}}
PARTITION_TO_SPECS = {
    "test": {
        "placement_generalization": _ALL,
        "combinatorial_generalization": _ALL,
        "novel_object_generalization": _ALL,
        "novel_task_generalization": {"same_texture": None},
    }
}


def make(
    task_name: str,
    *,
    task_kwargs: dict | None = None,
    modalities: list[str] | None = None,
    hide_arm_rgb: bool = True,
) -> base.Environment:
    """Make an environment of the stand-in."""
    assert "openvima" not in sys.modules
    assert modalities == ["rgb", "segm"]
    assert task_kwargs == next(
        level[task_name] for level in PARTITION_TO_SPECS["test"].values() if task_name in level
    )
    return base.Environment(task_name, hide_arm_rgb)
