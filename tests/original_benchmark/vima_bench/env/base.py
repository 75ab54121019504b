"""The environment of the stand-in."""

import time
from types import SimpleNamespace
from typing import Any

import numpy as np

SIZE = (8, 16)
NUM_STEPS = 3  # one of the oracle's and two more


class Environment:
    """An object lies in a column of the image; each pick there moves it.

    Two picks are a success, three where the seed is 2 modulo 8, four where it is 6. Multiples of 4 fail at
    once, and the first reset to an odd seed raises an error.
    """

    def __init__(self, task: str, hide_arm_rgb: bool) -> None:
        self.task, self._hide_arm = SimpleNamespace(oracle_max_steps=100), hide_arm_rgb
        self.task_name, self._attempts = task, 0
        self.global_seed = 0

    def reset(self) -> dict[str, Any]:
        self._attempts += 1
        if self.global_seed % 2 and self._attempts == 1:
            raise ValueError("no space")
        self._attempts, self._steps, self._picks = 0, 0, 0
        self.task.oracle_max_steps = NUM_STEPS - 2  # some tasks set it here
        self.prompt = "Put the {dragged_obj_1} as in {scene}, not the {dragged_obj_1}."
        info = {"obj_id": 0, "obj_name": "bowl", "obj_color": "red swirl"}
        scene = [info | {"obj_id": 5}, info | {"obj_id": 6, "obj_name": "block"}]
        self.prompt_assets = {
            "scene": self._asset("scene", scene),
            "dragged_obj_1": self._asset("object", info),
        }
        self.meta_info = {"obj_id_to_info": {6: {}, 5: {}}, "robot_components": [2, 3, 4]}
        return self._observation()

    def step(self, action: dict[str, np.ndarray]) -> tuple:
        assert {name: (value.shape, value.dtype) for name, value in action.items()} == {
            f"pose{n}_{part}": ((size,), np.float32)
            for n in (0, 1)
            for part, size in (("position", 2), ("rotation", 4))
        }
        assert self._steps < NUM_STEPS
        assert time.time() < 10_000  # limits in seconds count CPU time
        self._steps += 1
        self._picks += int(action["pose0_position"][0] * 100) == self._column
        failure = self.global_seed % 4 == 0
        info = {"prompt": self.prompt, "success": self._picks == self._wanted, "failure": failure}
        return self._observation(), 0, info["success"] or failure, info

    def close(self) -> None:
        pass

    @property
    def _wanted(self) -> int:
        return {2: 3, 6: 4}.get(self.global_seed % 8, 2)

    @property
    def _column(self) -> int:
        return (self.global_seed + 3 * self._picks) % SIZE[1]

    def _asset(self, kind: str, info: dict | list) -> dict[str, Any]:
        images = {view: np.full((3, *SIZE), self.global_seed % 256, np.uint8) for view in ("front", "top")}
        segm = {view: np.full(SIZE, 255, np.uint8) for view in images}
        return {"rgb": images, "segm": segm | {"obj_info": info}, "placeholder_type": kind}

    def _observation(self) -> dict[str, Any]:
        segm = np.ones(SIZE, np.uint8)
        segm[0] = 0
        segm[1, :3] = 2, 3, 4  # arm and tool
        segm[2, self._column], segm[3] = 5, 6
        rgb = np.zeros((3, *SIZE), np.uint8)
        rgb[:, 1, :3] = 0 if self._hide_arm else 9
        views = {"front": np.asfortranarray(segm), "top": segm}
        return {"rgb": {"front": rgb, "top": rgb}, "segm": views, "ee": 0}
