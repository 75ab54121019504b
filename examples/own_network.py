"""A small network of your own, as a policy; `own_training_loop.py` trains it."""

from pathlib import Path

import torch
from torch.nn import GELU, Conv2d, Sequential

from openvima.render import TOP, unproject
from openvima.scene import Action

WEIGHTS = Path(__file__).with_suffix(".pt")
# x, y in metres on the table of every fourth pixel of the top view
POINTS = torch.from_numpy(unproject(4 * torch.ones(32, 64).nonzero().flip(1).numpy() + 1.5, TOP)).float()


class Pixels(Sequential):
    """Picks and places at points of the top view that resemble the first and the last prompt image."""

    def forward(self, top, prompt):  # uint8 (B, 3, 128, 256), (B, P, 3, 128, 256)
        """Return a logit for pick and place at each point, (B, 2, 2048)."""
        seen, shown = (super(Pixels, self).forward(x / 255) for x in (top, prompt[:, [0, -1]].flatten(0, 1)))
        return torch.einsum("bchw,bic->bihw", seen, shown.amax((2, 3)).unflatten(0, (-1, 2))).flatten(2)

    def reset(self, prompts):
        """Start a batch of episodes."""
        self.prompts = [torch.stack([torch.tensor(i.rgb["top"]) for i in p.images.values()]) for p in prompts]

    def act(self, observations):
        """Return the actions of the episodes that are not over."""
        pairs = zip(observations, self.prompts, strict=True)
        best = [o and self(torch.tensor(o["rgb"]["top"])[None], p[None])[0].argmax(1) for o, p in pairs]
        return [None if b is None else Action.planar(*POINTS[b].tolist()).to_arrays() for b in best]


def make():
    """Return the policy, with its weights once it has been trained."""
    policy = Pixels(Conv2d(3, 32, 8, 4, 2), GELU(), Conv2d(32, 32, 5, 1, 2), GELU(), Conv2d(32, 32, 5, 1, 2))
    if WEIGHTS.exists():
        policy.load_state_dict(torch.load(WEIGHTS, weights_only=True))
    return policy
