"""Roll out your own policy: anything with `reset(prompts)` and `act(observations)`.

Run it with `python examples/02_score_your_policy.py`. This policy ignores the prompt and puts the second
largest visible object into the largest, which solves about half of the episodes. The loop over steps is
explicit; `custom_policy.py` has a policy that uses the prompt, evaluated in one line.
"""

import numpy as np

import openvima
from openvima.render import TOP, unproject
from openvima.scene import FIRST_OBJECT_ID


class IntoTheLargest:
    """Puts the second largest object into the largest."""

    def reset(self, prompts):
        """Start a batch of episodes; a real policy encodes the prompts here."""

    def act(self, observations):
        """Return an action for each observation; None stands for an episode that is over."""
        return [None if o is None else self._decide(o) for o in observations]

    def _decide(self, observation):
        segm = observation["segm"]["top"]
        ids, counts = np.unique(segm[(segm >= FIRST_OBJECT_ID["suction"]) & (segm < 255)], return_counts=True)
        largest = ids[np.argsort(-counts, kind="stable")][:2]
        points = [np.argwhere(segm == i).mean(axis=0)[::-1] for i in largest]  # column, row
        place, pick = unproject(np.array([points[0], points[-1]]), TOP)[:, :2].astype(np.float32)
        rotation = np.array([0, 0, 0, 1], np.float32)
        return {
            "pose0_position": pick,
            "pose0_rotation": rotation,
            "pose1_position": place,
            "pose1_rotation": rotation,
        }


def score(policy, task, level, episodes):
    """Roll out episodes and return the success rate."""
    env = openvima.make(task, level=level, domain="eval").unwrapped
    solved = 0
    for seed in range(episodes):
        observation, info = env.reset(seed=seed)
        policy.reset([env.prompt])
        over = False
        while not over:
            (action,) = policy.act([observation])
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        solved += info["success"]
    return solved / episodes


print(
    f"visual_manipulation, L1: {100 * score(IntoTheLargest(), 'visual_manipulation', 'L1', 20):.0f} % solved"
)
