"""Run a vision-language-action model: `python examples/vla_policy.py`.

The model here is a rule that reads words for colours (`language_rule.py`). A network takes its place.
"""

from collections import deque

import numpy as np

from language_rule import commands, primitive
from openvima.data.lerobot import frame_layout
from openvima.evaluation import score


class VlaPolicy:
    """Executes the chunks of actions that a model decides.

    Args:
        model: `model(text, images, state)` returns a row of `action`, or several to be executed in turn.
            `images` maps "front" and "top" to uint8 arrays (128, 256, 3), `state` is float32. All are as in
            the LeRobot export.
        control: "primitives" for rows of 12 numbers, "end_effector" for rows of 5.
        num_prompt_images: How many images of the prompt are among `images`, as "prompt_0_front" and so on.
    """

    modalities = ("rgb", "joints")  # no segmentation

    def __init__(self, model, control="primitives", num_prompt_images=0):
        self.model, self.control = model, control
        self.layout = frame_layout(control, num_prompt_images, has_joints=True)

    def reset(self, prompts):
        """Start a batch of episodes."""
        self.episodes = [(prompt, deque()) for prompt in prompts]

    def act(self, observations):
        """Return an action for each observation; None stands for an episode that is over."""
        pairs = zip(self.episodes, observations, strict=True)
        return [None if seen is None else self._next(*episode, seen) for episode, seen in pairs]

    def _next(self, prompt, rows, seen):
        if not rows:
            frame = self.layout.frame(seen, prompt)
            rows.extend(np.atleast_2d(self.model(prompt.text, frame["pixels"], frame["agent_pos"])))
        return self.layout.action(rows.popleft())  # refuses another shape or dtype


def primitives():
    """Return the policy for `openvima evaluate --policy examples/vla_policy.py:primitives`."""
    return VlaPolicy(primitive)


def end_effector():
    """Return the policy for `--policy examples/vla_policy.py:end_effector --control end_effector`."""
    return VlaPolicy(commands, "end_effector")


if __name__ == "__main__":
    where = {"tasks": ("visual_manipulation", "rotate"), "levels": ("L2",), "episodes": 10, "prompts": "text"}
    for policy in (primitives(), end_effector()):
        for row in score({"rule": policy}, **where, control=policy.control).rows:
            print(f"{row.task}, {policy.control}: solved {row.successes} of {row.episodes}")
