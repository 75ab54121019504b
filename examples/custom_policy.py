"""A policy of your own: `reset(prompts)` and `act(observations)` are all it needs; it inherits from nothing.

Run it with `python examples/custom_policy.py`. This one knows no network and was never trained. It compares
colours: what in view looks like the first image of the prompt is picked, what looks like the last is where it
goes; a number in the prompt is an angle. So it solves prompts of the form "Put the [image] into the [image]."
and "Rotate the [image] 60 degrees.", and no others.
"""

import re

import numpy as np

from openvima.evaluation import score
from openvima.perception.objects import observe, observe_prompt_image
from openvima.policies import RandomPolicy
from openvima.scene import Action

COLOURS = 6  # levels of red, green and blue that are told apart


def colours(objects, rgb, segm):
    """Describe each object by how often its pixels have each colour; shape (objects, all colours)."""
    counts = np.zeros((len(objects), COLOURS**3))
    for k, object_id in enumerate(objects.ids):
        for view, image in rgb.items():
            red, green, blue = image[:, segm[view] == object_id].astype(int) * COLOURS // 256
            np.add.at(counts[k], (red * COLOURS + green) * COLOURS + blue, 1)
    return np.sqrt(counts / counts.sum(axis=1, keepdims=True))


class NearestColour:
    """Picks what looks like the prompt's first image and puts it where the last image's likeness is."""

    def reset(self, prompts):
        """Begin a batch of episodes: keep what the images look like, and the angle."""
        self.wanted = [self._read(prompt) for prompt in prompts]

    def act(self, observations):
        """Return an action for each observation; None stands for an episode that is over."""
        pairs = zip(self.wanted, observations, strict=True)
        return [None if seen is None else self._decide(*wanted, seen) for wanted, seen in pairs]

    def _read(self, prompt):
        images = [part for part in prompt.sequence() if not isinstance(part, str)]
        seen = [colours(observe_prompt_image(image), image.rgb, image.segm)[0] for image in images]
        angle = re.search(r"\d+ degrees", prompt.text)
        return np.stack(seen), 0 if angle is None else int(angle[0].split()[0])

    def _decide(self, wanted, angle_deg, seen):
        objects = observe(seen)  # with crops, boxes and points on the table
        alike = wanted @ colours(objects, seen["rgb"], seen["segm"]).T  # images × objects
        pick = objects.grasp_points()[alike[0].argmax()]
        place = pick if len(wanted) == 1 else objects.positions()[alike[-1].argmax()]
        return Action.planar(tuple(pick), tuple(place), -np.deg2rad(angle_deg)).to_arrays()


if __name__ == "__main__":
    policies = {"nearest-colour": NearestColour(), "random": RandomPolicy(seed=0)}
    results = score(policies, tasks=("visual_manipulation", "rotate"), levels=("L1", "L3"), episodes=20)
    print("Solved episodes in %, with 95 % intervals")
    for row in results.rows:
        low, high = (100 * end for end in row.interval)
        print(f"{row.policy:15} {row.task:20} {row.level} {100 * row.rate:4.0f} ({low:.0f}–{high:.0f})")
