"""Move the tool ten times a second, in closed loop: `python examples/end_effector.py`."""

import numpy as np

from openvima.evaluation import score
from openvima.perception.objects import observe, observe_prompt_image

FASTEST = np.array([0.05, 0.05, 0.05, 0.2])  # in one step of 0.1 s: metres along x, y, z, and radians


def colour(rgb, segm, i):
    """Return the mean colour of an object in both views."""
    return np.concatenate([rgb[view][:, segm[view] == i] for view in rgb], axis=1).mean(axis=1)


def carry(images):
    """Yield commands and get observations: to the colour of the last image from that of the first."""
    wanted = [colour(image.rgb, image.segm, observe_prompt_image(image).ids[0]) for image in images]
    seen = yield
    objects = observe(seen)
    colours = np.array([colour(seen["rgb"], seen["segm"], i) for i in objects.ids])
    pick = objects.grasp_points()[np.abs(colours - wanted[0]).sum(axis=1).argmin()]
    base = objects.positions()[np.abs(colours - wanted[-1]).sum(axis=1).argmin()]
    for (x, y), z, suction in ((pick, 0.2, 0), (pick, 0, 1), (pick, 0.2, 1), (base, 0.2, 1), (base, 0, 1)):
        pose = np.full(4, np.inf)
        while np.abs(seen["tool"][:4] - pose).max() > 1e-4:  # until it stops, for z = 0 at contact
            pose = seen["tool"][:4]
            delta = np.clip((x, y, z, 0) - pose, -FASTEST, FASTEST)
            seen = yield np.append(delta, suction).astype(np.float32)
    while True:
        yield np.zeros(5, np.float32)  # suction off


class CarryToColour:
    """A policy of control "end_effector": `act` returns commands of the tool."""

    control = "end_effector"

    def reset(self, prompts):
        """Start a batch of episodes."""
        self.motions = [carry([*prompt.images.values()]) for prompt in prompts]
        for motion in self.motions:
            next(motion)

    def act(self, observations):
        """Return a command for each observation; None stands for an episode that is over."""
        pairs = zip(self.motions, observations, strict=True)
        return [None if seen is None else motion.send(seen) for motion, seen in pairs]


if __name__ == "__main__":
    where = {"tasks": ("visual_manipulation",), "levels": ("L2",), "episodes": 6}
    (row,) = score({"mine": CarryToColour()}, **where, control="end_effector").rows
    print(f"Solved: {100 * row.rate:.0f} % in {row.mean_steps / 10:.1f} s on average.")
