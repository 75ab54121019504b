"""Pairs of one object, alone in a prompt image and among others in a scene, and the loss that matches them.

Scenes are drawn for this purpose from the training partition: sampled like episodes of the tasks in the data,
then every object gets another texture of its role in training and a prompt image of its own. Nothing of the
test levels is ever shown. If wanted, part of the looks are random ones of no catalogue, some objects have a
twin, and each scene is laid a second time with everything turned.
"""

from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional as F

from openvima.catalog.geometry import Assets
from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import Pool, pool
from openvima.catalog.random_pack import RandomAppearanceAssets, has_visible_heading
from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.perception.objects import ObjectViews, extract_objects, observe_prompt_image
from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.render.rasteriser import PROMPT_POSE, Rasteriser
from openvima.scene import Episode, ObjectImage, Placement, Prompt, Scene
from openvima.tasks import sample_episode
from openvima.tasks.table import NO_SCALE
from openvima.training.scene_variants import laid_again, with_random_looks, with_twins
from openvima.training.schedule import step_seed

_NUM_COLUMNS = 8  # of `Pairs`, those of the scene laid again left out
_DOMAIN = "user"  # neither training nor evaluation episodes are reused


@dataclass(frozen=True, slots=True, eq=False)
class Again:
    """K objects in a scene that was laid again.

    Args:
        crops: Shape (K, 2, 3, 32, 32), uint8.
        masks: Whether it is visible in the view, shape (K, 2), bool.
        turns: Turn from the prompt image to the scene, and from there to the scene laid again,
            counter-clockwise seen from above, in radians; NaN for shapes that do not show it. Shape (K, 2),
            float32.
    """

    crops: torch.Tensor
    masks: torch.Tensor
    turns: torch.Tensor


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
        shapes: Number of its shape, shape (K,), int64.
        grays: Whether the prompt image shows it in gray, so that only its shape tells it, shape (K,), bool.
        again: The objects in the scene laid again; None if it was laid once.
    """

    prompt_crops: torch.Tensor
    prompt_masks: torch.Tensor
    scene_crops: torch.Tensor
    scene_masks: torch.Tensor
    looks: torch.Tensor
    scenes: torch.Tensor
    shapes: torch.Tensor
    grays: torch.Tensor
    again: Again | None = None

    def to(self, device: torch.device) -> "Pairs":
        """Return the pairs on another device."""
        return self._each(lambda column: column.to(device))

    def select(self, rows: torch.Tensor) -> "Pairs":
        """Return some of the pairs."""
        return self._each(lambda column: column[rows])

    def _each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> "Pairs":
        again = self.again
        return Pairs(
            change(self.prompt_crops),
            change(self.prompt_masks),
            change(self.scene_crops),
            change(self.scene_masks),
            change(self.looks),
            change(self.scenes),
            change(self.shapes),
            change(self.grays),
            Again(change(again.crops), change(again.masks), change(again.turns)) if again else None,
        )


@dataclass(frozen=True, slots=True)
class Variety:
    """What scenes show beyond the training partition laid once.

    Args:
        random_looks: How probable a random texture is for each object, and how probable a random shape.
        twins: How probable a twin is that differs in height, shade, texture or shape alone.
        again: Lay each scene a second time, with everything turned.
        grays: How probable it is for each object that its prompt image is gray, as in `novel_noun`.
    """

    random_looks: float = 0.0
    twins: float = 0.0
    again: bool = False
    grays: float = 0.0


PLAIN = Variety()


def render_pairs(
    tasks: Sequence[str],
    *,
    num_scenes: int,
    seed: int,
    assets: str,
    variety: Variety = PLAIN,
    report=None,
) -> Pairs:
    """Draw scenes and the prompt images of everything in them.

    Args:
        tasks: Tasks whose training partition and ways of laying the table are used, in turn.
        num_scenes: How many scenes.
        seed: Seed of the run.
        assets: Asset pack, as `load_assets` takes it.
        variety: What scenes show beyond that.
        report: Called with scenes done, scenes in all, and a note.
    """
    pack = load_assets(assets)
    rasteriser = Rasteriser(RandomAppearanceAssets(pack))
    shades = {name for task in tasks for name in pool(task, "train").dragged_textures}
    looks: dict[tuple, int] = {}
    columns: list[tuple] = []
    for number in range(num_scenes):
        task = tasks[number % len(tasks)]
        episode_seed = step_seed(seed, "pretraining scene", number)
        episode = sample_episode(task, level="train", seed=episode_seed, domain=_DOMAIN, assets=pack)
        textures = pool(task, "train")
        scene = _retextured(episode.problem.scene, textures, np.random.default_rng(episode_seed))
        # Of its own, so that the same scenes are laid whatever comes on top.
        rng = np.random.default_rng([episode_seed, 1])
        scene = _varied(scene, variety, shades, rasteriser.assets, rng)
        again = laid_again(scene, rng) if variety.again else None
        grays = rng.random(len(scene.placements)) < variety.grays
        enlarged = _magnifications(episode)
        columns += pairs_of_scene(scene, enlarged, rasteriser, looks, number, again, grays=grays)
        if report and number % 50 == 0:
            report(number, num_scenes, "drawing scenes")
    return stacked(columns)


def stacked(rows: Sequence[tuple]) -> Pairs:
    """Put the pairs of several scenes, as `pairs_of_scene` returns them, into one record."""
    columns = [torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True)]
    first, again = columns[:_NUM_COLUMNS], columns[_NUM_COLUMNS:]
    return Pairs(*first, again=Again(*again) if again else None)


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
    loss, accuracy = contrast(prompt, scene, alike_in_prompts(pairs), temperature=temperature)
    return loss, {"loss/contrastive": loss.detach(), "contrastive_accuracy": accuracy}


def alike_in_prompts(pairs: Pairs) -> torch.Tensor:
    """Tell which prompt image (row) could show which object (column) of a batch, (K, K), bool.

    One in colour shows objects of its look, a gray one those of its shape.
    """
    same_shape = (pairs.shapes[:, None] == pairs.shapes[None, :]) & pairs.grays[:, None]
    return same_shape | (pairs.looks[:, None] == pairs.looks[None, :])


def contrast(
    first: torch.Tensor, second: torch.Tensor, alike: torch.Tensor, *, temperature: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss of telling which of K objects is which, in both directions, and the share that is right.

    Args:
        first: Embeddings, shape (K, A).
        second: Those of other images of the same objects, shape (K, A).
        alike: Which of the first look like which of the second and are not told apart, shape (K, K), bool.
        temperature: Divisor of the similarities.
    """
    scores = first @ second.T / temperature
    count = len(scores)
    diagonal = torch.eye(count, dtype=torch.bool, device=scores.device)
    scores = scores.masked_fill(alike & ~diagonal, torch.finfo(scores.dtype).min)
    target = torch.arange(count, device=scores.device)
    loss = (F.cross_entropy(scores, target) + F.cross_entropy(scores.T, target)) / 2
    with torch.no_grad():
        accuracy = (scores.argmax(1) == target).to(scores.dtype).mean()
    return loss, accuracy


@torch.no_grad()
def scene_accuracy(encoder: ObjectEncoder, pairs: Pairs, *, chunk: int = 256) -> float:
    """Share of prompt images whose object is the most similar one of its scene; what a policy needs."""
    rows = torch.arange(len(pairs.looks), device=pairs.looks.device).split(chunk)
    parts = [pairs.select(row) for row in rows]
    prompt = torch.cat([embed_looks(encoder, p.prompt_crops, p.prompt_masks) for p in parts])
    scene = torch.cat([embed_looks(encoder, p.scene_crops, p.scene_masks) for p in parts])
    apart = pairs.scenes[:, None] != pairs.scenes[None, :]
    nearest = (prompt @ scene.T).masked_fill(apart, -2.0).argmax(1)
    is_right = pairs.looks[nearest] == pairs.looks
    is_right |= pairs.grays & (pairs.shapes[nearest] == pairs.shapes)
    return float(is_right.double().mean())


def pairs_again(pairs: Pairs, again: Again) -> Pairs:
    """Put the scene laid again in the place of prompt images, for the objects that show there."""
    shown = torch.nonzero(again.masks.any(dim=1))[:, 0]
    grays = torch.zeros_like(pairs.grays)
    return replace(pairs, prompt_crops=again.crops, prompt_masks=again.masks, grays=grays).select(shown)


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


def _varied(
    scene: Scene, variety: Variety, shades: AbstractSet[str], assets: Assets, rng: np.random.Generator
) -> Scene:
    if variety.random_looks:
        scene = with_random_looks(scene, variety.random_looks, assets, rng)
    return with_twins(scene, variety.twins, shades, assets, rng) if variety.twins else scene


def pairs_of_scene(
    scene: Scene,
    magnifications: Mapping[str, float],
    rasteriser: Rasteriser,
    looks: dict[tuple, int],
    number: int,
    again: tuple[Scene, dict[int, float]] | None = None,
    *,
    grays: Sequence[bool] | np.ndarray = (),
) -> list[tuple]:
    """Draw a scene and the prompt images of what it shows.

    Args:
        scene: The scene.
        magnifications: How much prompt images enlarge each kind of object; others are not enlarged.
        rasteriser: Draws.
        looks: Numbers of looks, by object and texture, and of shapes, by object; where the scene is laid
            again objects may be twins, and stretched ones have looks of their own. New ones are added.
        number: Number of the scene.
        again: The scene laid again, and turns by object id.
        grays: For each object of the scene whether its prompt image is gray; none of them by default.

    Returns:
        For each object that shows the fields of `Pairs`, and those of `Again` if it is laid again.
    """
    seen = _seen(scene, rasteriser)
    moved = _seen(again[0], rasteriser) if again else None
    pairs = []
    for slot, placement in enumerate(scene.placements):
        if not seen.masks[:, slot].any():
            continue
        is_gray = bool(len(grays)) and bool(grays[slot])
        pictured = replace(placement, texture=NEUTRAL_TEXTURE, scale=NO_SCALE) if is_gray else placement
        shown = _prompt_image(pictured, magnifications.get(placement.object, 1.0), rasteriser)
        key = (placement.object, placement.texture, *(placement.scale if again else ()))
        look = looks.setdefault(key, len(looks))
        shape = looks.setdefault((placement.object,), len(looks))
        pair = (
            shown.crops[:, 0],
            shown.masks[:, 0],
            seen.crops[:, slot],
            seen.masks[:, slot],
            np.int64(look),
            np.int64(number),
            np.int64(shape),
            np.bool_(is_gray),
        )
        if again and moved:
            from_prompt = placement.pose.yaw_rad - PROMPT_POSE.yaw_rad
            turns = np.array([from_prompt, again[1][placement.id]], dtype=np.float32)
            turns = turns if has_visible_heading(placement.object) else np.full_like(turns, np.nan)
            pair = (*pair, moved.crops[:, slot], moved.masks[:, slot], turns)
        pairs.append(pair)
    return pairs


def _seen(scene: Scene, rasteriser: Rasteriser) -> ObjectViews:
    views = rasteriser.scene(scene)
    rgb = {name: image.rgb for name, image in views.items()}
    segm = {name: image.segm for name, image in views.items()}
    return extract_objects(rgb, segm, [placement.id for placement in scene.placements])


def _prompt_image(placement: Placement, magnification: float, rasteriser: Rasteriser):
    image = ObjectImage(placement, magnification)
    prompt = rasteriser.prompt(Prompt("{object}", (("object", image),)))
    return observe_prompt_image(prompt.images["object"])
