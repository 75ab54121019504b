"""Ask for the arm's joints and for depth: `python examples/joints_and_depth.py`.

The policy declares what it reads, and evaluations provide it. Its state is that of the LeRobot export.
"""

import re

import numpy as np

from openvima.evaluation import score
from openvima.render import TOP, points_from_depth
from openvima.scene import Action


class RotateTheTallest:
    """Rotates what rises highest above the table, by the angle that the prompt names."""

    modalities = ("depth", "joints")  # what observations hold besides `ee`

    def reset(self, prompts):
        """Start a batch of episodes."""
        self.angles = [float(re.search(r"(\d+) degrees", prompt.text)[1]) for prompt in prompts]

    def act(self, observations):
        """Decide the next action of every episode that is not over."""
        pairs = zip(observations, self.angles, strict=True)
        return [None if seen is None else self._decide(seen, angle) for seen, angle in pairs]

    def _decide(self, seen, angle_deg):
        self.state = np.append(seen["joints"], np.float32(seen["ee"]))  # as `observation.state` in the export
        points = points_from_depth(seen["depth"]["top"], TOP)  # x, y, z of the surface at each pixel, metres
        x, y, _ = points[np.unravel_index(points[..., 2].argmax(), points.shape[:2])]
        return Action.planar((x, y), (x, y), -np.deg2rad(angle_deg)).to_arrays()


if __name__ == "__main__":
    policy = RotateTheTallest()
    (row,) = score({"tallest": policy}, tasks=("rotate",), levels=("L1",), episodes=10).rows
    print(f"Solved: {100 * row.rate:.0f} %. Last state:", policy.state)
