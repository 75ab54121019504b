"""A network of your own, trained by `openvima train` and scored like any other.

    openvima generate --tasks visual_manipulation --episodes 200 --out demos
    openvima train --data demos --preset examples/custom_learner.py:make --out run
    # or by the name that it registers:
    OPENVIMA_POLICY_FILES=examples/custom_learner.py openvima train --data demos --preset matcher --out run
    openvima evaluate --policy run --trust-code --tasks visual_manipulation --levels L1,L3 --episodes 20

The training loop provides recipes, exact resuming, validation, multi-process training and mixed precision. A
learner needs three methods: `collator` makes batches of demonstrations, `forward` returns the loss, `policy`
returns the policy that acts with the weights. This one embeds object crops, picks the object most similar to
the first prompt image, and places it on the object most similar to the last one.
"""

import torch
from torch import nn
from torch.nn import functional as F

from openvima.perception.objects import observe, observe_prompt_image
from openvima.policies import register_policy
from openvima.policies.processor import Processor
from openvima.scene import Action
from openvima.training.learner import Learner, PolicyCollate


class Matcher(Learner):
    """Points at the objects most similar to the first and the last prompt image."""

    score = "pick_accuracy"

    def __init__(self):
        super().__init__()
        layers = [nn.Conv2d(6, 32, 4, 4), nn.GELU(), nn.Conv2d(32, 64, 4, 4), nn.GELU(), nn.Flatten()]
        self.embed = nn.Sequential(*layers, nn.Linear(256, 64))

    def collator(self):
        """The crops, boxes and targets of the built-in policies, with 5 % false detections."""
        return PolicyCollate(Processor("objects"), 0.05, with_images=True)

    def forward(self, batch):
        """Cross-entropy of the object to pick and of the object to place it on."""
        appearance = self.embed_objects(
            batch.images, batch.history.crop_index_BTVN.movedim(2, -1)
        )  # (B, T, N, 64)
        prompt_objects = self.embed_objects(batch.images, batch.prompts.crop_index_VS.T)
        rows = batch.prompts.object_index_BL  # prompt object at each position; negative for words
        first, last = (prompt_objects[torch.stack([row[row >= 0][end] for row in rows])] for end in (0, -1))
        hidden = ~batch.history.masks_BTVN.any(dim=2)
        losses, metrics = [], {}
        for name, image, slots in (
            ("pick", first, batch.targets.pick_BT),
            ("place", last, batch.targets.place_BT),
        ):
            scores = torch.einsum("btnd,bd->btn", appearance, image).masked_fill(hidden, -1e4)[slots >= 0]
            losses.append(F.cross_entropy(scores, slots[slots >= 0]))
            metrics[f"{name}_accuracy"] = (scores.argmax(-1) == slots[slots >= 0]).float().mean()
        return sum(losses), metrics

    def policy(self):
        """Return the policy that `openvima evaluate` scores."""
        return MatcherPolicy(self)

    def embed_objects(self, images, crop_index):
        """Embed objects from their crops in both views: crop indices (..., 2) to (..., 64)."""
        crops = images[crop_index].flatten(-4, -3).float() / 255  # views as channels
        return 8 * F.normalize(self.embed(crops.flatten(0, -4)), dim=-1).unflatten(0, crop_index.shape[:-1])


class MatcherPolicy:
    """The trained network as a policy."""

    def __init__(self, network):
        self.network = network

    def reset(self, prompts):
        """Start a batch of episodes."""
        images = [[part for part in prompt.sequence() if not isinstance(part, str)] for prompt in prompts]
        self.targets = [[observe_prompt_image(each[end]) for end in (0, -1)] for each in images]

    @torch.no_grad()
    def act(self, observations):
        """Return an action for every running episode."""
        pairs = zip(self.targets, observations, strict=True)
        return [None if each is None else self._action(targets, observe(each)) for targets, each in pairs]

    def _action(self, targets, objects):
        appearance = self._embed(objects)
        pick, place = ((appearance @ self._embed(image)[0]).argmax().item() for image in targets)
        points = objects.grasp_points()[pick], objects.positions()[place]
        return Action.planar(*(tuple(point) for point in points), 0.0).to_arrays()

    def _embed(self, objects):
        images = torch.from_numpy(objects.crops).flatten(0, 1)  # front views, then top views
        crop_index = torch.arange(len(images)).view(2, -1).T
        return self.network.embed_objects(images, crop_index)


@register_policy("matcher")
def make():
    """Return the learner that `--preset` names."""
    return Matcher()
