"""A small network of your own, as a policy; `own_training_loop.py` trains it."""

from pathlib import Path

import torch
from torch.nn import GELU, Conv2d, Sequential
from torch.nn.functional import normalize, one_hot

from openvima.perception.objects import observe
from openvima.scene import Action

WEIGHTS = Path(__file__).with_suffix(".pt")


class Matcher(Sequential):
    """Picks and places at the objects that resemble the first and the last prompt image, in the top view."""

    def forward(self, rgb, segm, prompt_rgb, prompt_segm):  # top views (N, …), of prompts (N, P, …)
        """Return a logit for pick and place of each object id below 32, (N, 2, 32)."""
        shown = self._embed(prompt_rgb[:, [0, -1]].flatten(0, 1), prompt_segm[:, [0, -1]].flatten(0, 1))
        return 10 * torch.einsum("nic,nkc->nik", shown[:, 0].unflatten(0, (-1, 2)), self._embed(rgb, segm))

    def _embed(self, rgb, segm):  # mean over the pixels of each id
        masks = one_hot(segm[:, ::4, ::4].long().clamp(max=31), 32).float()
        return normalize(torch.einsum("nchw,nhwk->nkc", super().forward(rgb / 255), masks), dim=-1)

    def reset(self, prompts):
        """Start a batch of episodes."""
        self.prompts = [list(prompt.images.values()) for prompt in prompts]

    def act(self, observations):
        """Return the actions of the episodes that are not over."""
        pairs = zip(observations, self.prompts, strict=True)
        return [seen and self._decide(seen, prompt) for seen, prompt in pairs]

    def _decide(self, seen, prompt):
        views = [torch.tensor(seen[kind]["top"]) for kind in ("rgb", "segm")]
        shown = [
            torch.stack([torch.tensor(getattr(i, kind)["top"]) for i in prompt]) for kind in ("rgb", "segm")
        ]
        objects = observe(seen)
        pick, place = self(*(x[None] for x in (*views, *shown)))[0][:, objects.ids.tolist()].argmax(1)
        return Action.planar(
            tuple(objects.grasp_points()[pick]), tuple(objects.positions()[place])
        ).to_arrays()


def make():
    """Return the policy, with its weights once it has been trained."""
    policy = Matcher(Conv2d(3, 32, 8, 4, 2), GELU(), Conv2d(32, 32, 1))
    if WEIGHTS.exists():
        policy.load_state_dict(torch.load(WEIGHTS, weights_only=True))
    return policy
