"""Batches of infos are those of Gymnasium."""

from typing import Any  # infos are nested dictionaries

import numpy as np
from gymnasium.vector import VectorEnv

from openvima.env.sub_environments import batch_infos
from task_cases import full_repr


class Gathering(VectorEnv):
    """Only for what it inherits: how infos are gathered."""

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs


def gathered(infos: list[dict[str, Any] | None]) -> dict[str, Any]:
    batch: dict[str, Any] = {}
    envs = Gathering(len(infos))
    for index, info in enumerate(infos):
        if info is not None:
            batch = envs._add_info(batch, info, index)
    return batch


def test_infos_are_joined_as_gymnasium_does() -> None:
    full = {
        "prompt": "Put it there.",
        "failure": None,
        "success": False,
        "num_steps": 2,
        "joints": np.arange(6, dtype=np.float32),
        "scale": np.float32(0.5),
        "progress": {"goals_met": 0.5, "distance_m": np.nan, "deeper": {"count": 1}},
        "objects": {}.keys(),
    }
    ended = {"final_obs": {"ee": 1}, "final_info": full, **full, "success": True}
    for infos in ([full, ended], [None, full, ended, None], [ended, None, {"num_steps": 7}], [None, {}], []):
        ours, theirs = batch_infos(infos), gathered(infos)
        assert full_repr(ours) == full_repr(theirs)
        assert dtypes(ours) == dtypes(theirs)


def dtypes(batch: dict[str, Any]) -> dict[str, Any]:
    return {key: dtypes(value) if isinstance(value, dict) else value.dtype for key, value in batch.items()}
