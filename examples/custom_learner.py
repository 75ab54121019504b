"""A network of your own, trained by `openvima train` and scored like any other.

    openvima generate --tasks visual_manipulation --episodes 200 --out demos
    PYTHONPATH=examples openvima train --data demos --preset custom_learner:make --out run
    PYTHONPATH=examples python examples/custom_learner.py run

The training loop gives it recipes, exact resuming, validation, several processes and half precision. Two
methods are needed: `collator` says how demonstrations become a batch, `forward` what its loss is. This one
embeds crops of objects, picks what looks most like the first image of the prompt, and puts it down on what
looks most like the last.
"""

import sys

import torch
from torch import nn
from torch.nn import functional as F

from openvima.evaluation import score
from openvima.perception.objects import observe, observe_prompt_image
from openvima.policies import RandomPolicy
from openvima.policies.processor import Processor
from openvima.policies.sources import checkpoint_folder
from openvima.scene import Action
from openvima.training.learner import Learner, PolicyCollate


class Matcher(Learner):
    """Points at objects in view by their likeness to the first and the last image of the prompt."""

    score = "pick_accuracy"

    def __init__(self):
        super().__init__()
        layers = [nn.Conv2d(6, 32, 4, 4), nn.GELU(), nn.Conv2d(32, 64, 4, 4), nn.GELU(), nn.Flatten()]
        self.embed = nn.Sequential(*layers, nn.Linear(256, 64))

    def collator(self):
        """The crops, boxes and targets that policies of the package learn from; 5 % false detections."""
        return PolicyCollate(Processor("objects"), 0.05, with_images=True)

    def forward(self, batch):
        """Cross-entropy of the object to pick and of the one to place it on."""
        looks = self.looks(batch.images, batch.history.crop_index_BTVN.movedim(2, -1))  # (B, T, N, 64)
        wanted = self.looks(batch.images, batch.prompts.crop_index_VS.T)  # one row an object of the prompts
        rows = batch.prompts.object_index_BL  # which of them stands where in each prompt; negative for words
        first, last = (wanted[torch.stack([row[row >= 0][end] for row in rows])] for end in (0, -1))
        hidden = ~batch.history.masks_BTVN.any(dim=2)
        losses, metrics = [], {}
        for name, image, slots in (
            ("pick", first, batch.targets.pick_BT),
            ("place", last, batch.targets.place_BT),
        ):
            scores = torch.einsum("btnd,bd->btn", looks, image).masked_fill(hidden, -1e4)[slots >= 0]
            losses.append(F.cross_entropy(scores, slots[slots >= 0]))
            metrics[f"{name}_accuracy"] = (scores.argmax(-1) == slots[slots >= 0]).float().mean()
        return sum(losses), metrics

    def looks(self, images, numbers):
        """Embed objects by their crops in both views: (..., 2) numbers of images to (..., 64)."""
        crops = images[numbers].flatten(-4, -3).float() / 255  # the views become channels
        return 8 * F.normalize(self.embed(crops.flatten(0, -4)), dim=-1).unflatten(0, numbers.shape[:-1])


class MatcherPolicy:
    """The trained network as a policy."""

    def __init__(self, run):
        self.network = Matcher()
        self.network.read(checkpoint_folder(run))
        self.network.eval()

    def reset(self, prompts):
        """Begin a batch of episodes."""
        images = [[part for part in prompt.sequence() if not isinstance(part, str)] for prompt in prompts]
        self.wanted = [[observe_prompt_image(shown[end]) for end in (0, -1)] for shown in images]

    @torch.no_grad()
    def act(self, observations):
        """Decide for every episode that is not over."""
        pairs = zip(self.wanted, observations, strict=True)
        return [None if seen is None else self._decide(wanted, observe(seen)) for wanted, seen in pairs]

    def _decide(self, wanted, objects):
        looks = self._looks(objects)
        pick, place = ((looks @ self._looks(image)[0]).argmax().item() for image in wanted)
        points = objects.grasp_points()[pick], objects.positions()[place]
        return Action.planar(*(tuple(point) for point in points), 0.0).to_arrays()

    def _looks(self, objects):
        images = torch.from_numpy(objects.crops).flatten(0, 1)  # front views, then top views
        numbers = torch.arange(len(images)).view(2, -1).T
        return self.network.looks(images, numbers)


def make():
    """What `--preset custom_learner:make` calls."""
    return Matcher()


if __name__ == "__main__":
    from pathlib import Path

    policies = {"matcher": MatcherPolicy(Path(sys.argv[1])), "random": RandomPolicy(seed=0)}
    for row in score(policies, tasks=("visual_manipulation",), levels=("L1", "L3"), episodes=20).rows:
        low, high = (100 * end for end in row.interval)
        print(f"{row.policy:10} {row.task:20} {row.level} {100 * row.rate:4.0f} ({low:.0f}–{high:.0f})")
