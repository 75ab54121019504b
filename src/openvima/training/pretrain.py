"""Pairs of one object, alone in a prompt image and among others in a scene, and the loss that matches them.

Scenes are drawn for this purpose from the training partition: sampled like episodes of the tasks in the data,
then every object gets another texture of its role in training and a prompt image of its own. Nothing of the
test levels is ever shown.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional as F

from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import Pool, pool
from openvima.perception.objects import observe_prompt_image, see_objects
from openvima.policies.layers.object_encoder import ObjectEncoder
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Episode, ObjectImage, Placement, Prompt, Scene
from openvima.tasks import sample_episode
from openvima.training.schedule import step_seed

_DOMAIN = "user"  # neither training nor evaluation episodes are reused


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """K objects, each in a prompt image and in a scene.

    Args:
        prompt_crops: Shape (K, 2, 3, 32, 32), uint8.
        prompt_masks: Whether it is visible in the view, shape (K, 2), bool.
        scene_crops: Shape (K, 2, 3, 32, 32), uint8.
        scene_masks: Shape (K, 2), bool.
        looks: Number of its pair of shape and texture, shape (K,), int64.
        scenes: Number of its scene, shape (K,), int64.
    """

    prompt_crops: torch.Tensor
    prompt_masks: torch.Tensor
    scene_crops: torch.Tensor
    scene_masks: torch.Tensor
    looks: torch.Tensor
    scenes: torch.Tensor

    def to(self, device: torch.device) -> "Pairs":
        """Return the pairs on another device."""
        return Pairs(*(getattr(self, name).to(device) for name in self.__slots__))

    def select(self, rows: torch.Tensor) -> "Pairs":
        """Return some of the pairs."""
        return Pairs(
            self.prompt_crops[rows],
            self.prompt_masks[rows],
            self.scene_crops[rows],
            self.scene_masks[rows],
            self.looks[rows],
            self.scenes[rows],
        )


def render_pairs(tasks: Sequence[str], *, num_scenes: int, seed: int, assets: str, report=None) -> Pairs:
    """Draw scenes and the prompt images of everything in them.

    Args:
        tasks: Tasks whose training partition and ways of laying the table are used, in turn.
        num_scenes: How many scenes.
        seed: Seed of the run.
        assets: Asset pack, as `load_assets` takes it.
        report: Called with scenes done, scenes in all, and a note.
    """
    rasteriser = Rasteriser(load_assets(assets))
    looks: dict[tuple[str, str], int] = {}
    columns: list[tuple] = []
    for number in range(num_scenes):
        task = tasks[number % len(tasks)]
        episode_seed = step_seed(seed, "pretraining scene", number)
        episode = sample_episode(
            task, level="train", seed=episode_seed, domain=_DOMAIN, assets=rasteriser.assets
        )
        textures = pool(task, "train")
        scene = _retextured(episode.problem.scene, textures, np.random.default_rng(episode_seed))
        columns += _pairs_of_scene(scene, _magnifications(episode), rasteriser, looks, number)
        if report and number % 50 == 0:
            report(number, num_scenes, "drawing scenes")
    return Pairs(*(torch.from_numpy(np.stack(column)) for column in zip(*columns, strict=True)))


def matching_loss(
    encoder: ObjectEncoder, pairs: Pairs, *, temperature: float, generator: torch.Generator
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Loss of telling which prompt image shows which object of the batch, in both directions.

    Colours of the whole batch are mixed at random first, so that there are many more textures than the
    partition holds while telling them apart stays as hard.

    Args:
        encoder: Gets the gradient.
        pairs: A batch.
        temperature: Divisor of the similarities.
        generator: Draws the colours.

    Returns:
        The loss, and the share of objects matched within the batch.

    Source: InfoNCE (van den Oord et al. 2018), symmetric as in CLIP.
    """
    mixing = colour_mixing(generator).to(pairs.prompt_crops.device)
    prompt = embed_looks(encoder, pairs.prompt_crops, pairs.prompt_masks, mixing)
    scene = embed_looks(encoder, pairs.scene_crops, pairs.scene_masks, mixing)
    scores = prompt @ scene.T / temperature
    count = len(scores)
    diagonal = torch.eye(count, dtype=torch.bool, device=scores.device)
    same_look = (pairs.looks[:, None] == pairs.looks[None, :]) & ~diagonal
    scores = scores.masked_fill(same_look, torch.finfo(scores.dtype).min)
    target = torch.arange(count, device=scores.device)
    loss = (F.cross_entropy(scores, target) + F.cross_entropy(scores.T, target)) / 2
    with torch.no_grad():
        accuracy = (scores.argmax(1) == target).to(scores.dtype).mean()
    return loss, {"match_accuracy": accuracy}


@torch.no_grad()
def scene_accuracy(encoder: ObjectEncoder, pairs: Pairs, *, chunk: int = 256) -> float:
    """Share of prompt images whose object is the most similar one of its scene; what a policy needs."""
    rows = torch.arange(len(pairs.looks), device=pairs.looks.device).split(chunk)
    parts = [pairs.select(row) for row in rows]
    prompt = torch.cat([embed_looks(encoder, p.prompt_crops, p.prompt_masks) for p in parts])
    scene = torch.cat([embed_looks(encoder, p.scene_crops, p.scene_masks) for p in parts])
    apart = pairs.scenes[:, None] != pairs.scenes[None, :]
    nearest = (prompt @ scene.T).masked_fill(apart, -2.0).argmax(1)
    return float((pairs.looks[nearest] == pairs.looks).double().mean())


def embed_looks(
    encoder: ObjectEncoder, crops: torch.Tensor, masks: torch.Tensor, mixing: torch.Tensor | None = None
) -> torch.Tensor:
    """Embed K objects; crops (K, 2, 3, 32, 32), masks (K, 2), optional mixing of colours (3, 3)."""
    if mixing is not None:
        crops = torch.einsum("cd,kvdyx->kvcyx", mixing, crops.to(mixing.dtype))
    features = encoder.encode_images(crops)
    return encoder.embed_appearance(features.transpose(0, 1), masks.T)


def colour_mixing(generator: torch.Generator) -> torch.Tensor:
    """Draw a (3, 3) matrix that mixes R, G and B: half of the time not at all, else a blended permutation.

    Rows sum to 1, so that white, grey and black stay what they are.
    """
    if torch.rand((), generator=generator) < 0.5:
        return torch.eye(3)
    permutation = torch.eye(3)[torch.randperm(3, generator=generator)]
    blending = torch.rand(3, 3, generator=generator)
    share = 0.5 * torch.rand((), generator=generator)
    return (1 - share) * permutation + share * blending / blending.sum(1, keepdim=True)


def _retextured(scene: Scene, textures: Pool, rng: np.random.Generator) -> Scene:
    """Give every object a training texture; few different ones, so that many differ in shape alone.

    Movable objects get textures of dragged objects and fixed ones those of bases, so that the combinations
    of level L2, in which the two sets are swapped, stay unseen.
    """
    size = max(2, len(scene.placements) - 1)
    palettes = {
        fixed: rng.choice(names, size=size, replace=False) if names else ()
        for fixed, names in ((False, textures.dragged_textures), (True, textures.base_textures))
    }
    placements = [replace(p, texture=str(rng.choice(palettes[p.fixed]))) for p in scene.placements]
    return replace(scene, placements=tuple(placements))


def _magnifications(episode: Episode) -> dict[str, float]:
    """How much prompts of this task enlarge each kind of object."""
    images = [fill for _, fill in episode.problem.prompt.images if isinstance(fill, ObjectImage)]
    return {image.placement.object: image.magnification for image in images}


def _pairs_of_scene(
    scene: Scene,
    magnifications: dict[str, float],
    rasteriser: Rasteriser,
    looks: dict[tuple[str, str], int],
    number: int,
) -> list[tuple]:
    views = rasteriser.scene(scene)
    rgb = {name: image.rgb for name, image in views.items()}
    segm = {name: image.segm for name, image in views.items()}
    seen = see_objects(rgb, segm, [placement.id for placement in scene.placements])
    pairs = []
    for slot, placement in enumerate(scene.placements):
        if not seen.masks[:, slot].any():
            continue
        shown = _prompt_image(placement, magnifications.get(placement.object, 1.0), rasteriser)
        look = looks.setdefault((placement.object, placement.texture), len(looks))
        pairs.append(
            (
                shown.crops[:, 0],
                shown.masks[:, 0],
                seen.crops[:, slot],
                seen.masks[:, slot],
                np.int64(look),
                np.int64(number),
            )
        )
    return pairs


def _prompt_image(placement: Placement, magnification: float, rasteriser: Rasteriser):
    image = ObjectImage(placement, magnification)
    prompt = rasteriser.prompt(Prompt("{object}", (("object", image),)))
    return observe_prompt_image(prompt.images["object"])
