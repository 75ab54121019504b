"""Pairs for contrastive pretraining: one object alone in a prompt image and among others in a scene.

Scenes are sampled like episodes of the tasks in the data, from the training partition; then every object gets
another training texture of its role, and a prompt image of its own. Nothing comes from the test levels.
Labels say what the objects are like, in the attributes in which they are compared.
"""

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
import torch

from openvima.catalog.geometry import Assets
from openvima.catalog.objects import object_spec
from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import Pool
from openvima.catalog.random_pack import RandomAppearanceAssets, has_visible_heading, is_random
from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.multiprocess import Report, imap_unordered
from openvima.perception.objects import ObjectViews, extract_objects, observe_prompt_image
from openvima.policies.nn.layers import TensorRecord, map_tensors
from openvima.render.rasteriser import PROMPT_POSE, Rasteriser
from openvima.scene import ObjectImage, Placement, Prompt, Scene
from openvima.tasks import sample_episode, task_spec
from openvima.tasks.table import NO_SCALE
from openvima.training.augmentation.scenes import (
    rearrange,
    with_hard_negatives,
    with_random_appearance,
)
from openvima.training.config import PretrainingConfig
from openvima.training.loop import step_seed
from openvima.training.parallel import ONE_PROCESS, Parallel

_NUM_LEVELS = 4  # of each channel of a colour histogram
_NUM_DIRECTIONS = 72
_CORNERS = slice(_NUM_DIRECTIONS // 8, None, _NUM_DIRECTIONS // 4)  # the four diagonals
_ROUND_FROM = 0.9  # smallest reach of a circle, as a fraction of the largest; 0.92 for an octagon
_CORNERS_FROM = 1.75  # reach of a square into its corners, which is 2 unless they are open
_SIDES_WITHIN = 1.25  # ratio of the sides of a square; that of the catalogue's pallet is 1.2


@dataclass(frozen=True, slots=True, eq=False)
class AttributeLabels(TensorRecord):
    """What K objects are like in their prompt image and in their scene.

    Args:
        categories: `name_id` of texture, shape and profile, shape (K, 2, 3), int64.
        colours: Histograms of colours, shape (K, 2, 64), float32.
        lengths: Height, and mean width of the footprint, in metres; NaN if magnified. Shape (K, 2, 2),
            float32.
        boxes: In prompt image, scene and second view, in pixels, shape (K, 3, 2, 4), int64.
    """

    categories: torch.Tensor
    colours: torch.Tensor
    lengths: torch.Tensor
    boxes: torch.Tensor


def attributes_of_object(
    placement: Placement, assets: Assets, *, is_magnified: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return categories (3,), colours (64,) and lengths (2,) of an object."""
    # Ears are drawn after the container of the same seed; they change its outline, and not its profile.
    body = placement.object.replace("random eared", "random")
    vertices, of_body = (
        assets.geometry(name, placement.size, placement.scale).visual.vertices.reshape(-1, 3)
        for name in (placement.object, body)
    )
    names = (placement.texture, placement.object, profile(body, of_body))
    # The mean width of a footprint is twice its mean reach, whatever the middle.
    lengths = [np.ptp(vertices[:, 2]), 2 * _reach(vertices[:, :2]).mean()]
    known = np.array([math.nan, math.nan] if is_magnified else lengths, np.float32)
    return np.array([name_id(name) for name in names]), _histogram(assets, placement.texture), known


def name_id(*names: str) -> np.int64:
    """Return a number for names, the same in every process; different names have different ones."""
    digest = hashlib.blake2b("/".join(names).encode(), digest_size=8).digest()
    return np.int64(int.from_bytes(digest, "little") >> 1)


def profile(object_name: str, vertices: np.ndarray) -> str:
    """Return "circle", "square", or the object's name, since any other outline is a class of its own.

    Args:
        object_name: Of the catalogue, or random; a random shape is a class of its own.
        vertices: Shape (N, 3), metres.
    """
    if not is_random(object_name):
        return object_spec(object_name).profile or object_name
    if "shape" in object_name:
        return object_name
    points = vertices[:, :2] - (vertices[:, :2].max(axis=0) + vertices[:, :2].min(axis=0)) / 2
    reach = _reach(points)
    if reach.min() > _ROUND_FROM * reach.max():
        return "circle"
    return (
        "square" if any(_is_square(points @ _rotation(angle)) for angle in (0, math.pi / 4)) else object_name
    )


def _is_square(points: np.ndarray) -> bool:
    """Whether a footprint about the origin is a square along the axes, or nearly so."""
    x, y = np.abs(points).max(axis=0)
    corners = _reach(points / (x, y))[_CORNERS] * math.sqrt(2)
    return bool(corners.min() > _CORNERS_FROM and max(x, y) < _SIDES_WITHIN * min(x, y))


def _reach(points: np.ndarray) -> np.ndarray:
    """How far a footprint reaches in each of 72 directions, the first along x."""
    angles = np.arange(_NUM_DIRECTIONS) * (2 * math.pi / _NUM_DIRECTIONS)
    return (points @ np.stack([np.cos(angles), np.sin(angles)])).max(axis=0)


def _rotation(angle_rad: float) -> np.ndarray:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([(cos, sin), (-sin, cos)])


@lru_cache(4096)
def _histogram(assets: Assets, name: str) -> np.ndarray:
    """Soft histogram of the colours of a texture, shape (64,), float32; its sum is 1."""
    texture = assets.texture(name)
    pixels = texture.reshape(-1, 3)[:: max(1, texture.shape[0] * texture.shape[1] // 4096)]
    position = pixels / 255 * (_NUM_LEVELS - 1)
    weights = np.maximum(0, 1 - np.abs(position[..., None] - np.arange(_NUM_LEVELS)))  # (N, 3, levels)
    cells = np.einsum("ni,nj,nk->ijk", *weights.transpose(1, 0, 2)) / len(pixels)
    return cells.reshape(-1).astype(np.float32)


_NUM_COLUMNS = 7  # of `Pairs` without its labels
_CHUNK = 100  # scenes of a job
_DOMAIN = "user"  # neither training nor evaluation episodes are reused


PROMPT, SCENE, SECOND_VIEW = 0, 1, 2
"""Images of an object."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs(TensorRecord):
    """K objects, each in a prompt image and in a scene, and perhaps in a rearranged view of the scene.

    Args:
        crops: In each of S images, shape (K, S, 2, 3, 32, 32), uint8; S is 3 with the second view, else 2.
        masks: Whether it is visible in the view, shape (K, S, 2), bool.
        appearances: `name_id` of its pair of shape and texture, shape (K,), int64.
        scenes: Index of its scene, shape (K,), int64.
        shapes: `name_id` of its shape, shape (K,), int64.
        is_grayscale: Whether its prompt image is grayscale and matches by shape, shape (K,), bool.
        rotations: From the prompt image to the scene, and from there to the second view, counter-clockwise
            seen from above, in radians; NaN for shapes with rotational symmetry. Shape (K, 2), float32; None
            without the second view.
        attributes: What the objects are like; None if they are not labelled.
    """

    crops: torch.Tensor
    masks: torch.Tensor
    appearances: torch.Tensor
    scenes: torch.Tensor
    shapes: torch.Tensor
    is_grayscale: torch.Tensor
    rotations: torch.Tensor | None = None
    attributes: AttributeLabels | None = None

    def second_view_pairs(self) -> "Pairs":
        """Return the pairs with the second view as prompt images, where it shows the object."""
        images = [SECOND_VIEW, SCENE]
        pairs = replace(
            self,
            crops=self.crops[:, images],
            masks=self.masks[:, images],
            is_grayscale=torch.zeros_like(self.is_grayscale),
        )
        return pairs.select(torch.nonzero(self.masks[:, SECOND_VIEW].any(dim=1))[:, 0])


def render_pairs(
    tasks: Sequence[str],
    config: PretrainingConfig,
    *,
    seed: int,
    assets: str,
    second_view: bool = False,
    report: Report | None = None,
    parallel: Parallel = ONE_PROCESS,
    workers: int = 1,
) -> Pairs:
    """Sample and render scenes, and prompt images of all objects in them.

    The pairs do not depend on the number of processes or workers.

    Args:
        tasks: Tasks whose training partition and layouts are used, in turn.
        config: How many scenes, and how they are augmented. With a weight of attributes the pairs are
            labelled; this needs a second view.
        seed: Seed of the run.
        assets: Asset pack, as `load_assets` takes it.
        second_view: Add a rearranged view of each scene.
        report: Called with scenes done, scenes in all, and a note.
        parallel: Processes of the run that share the scenes; each returns all pairs, on its device.
        workers: Processes that render for them.
    """
    numbers = parallel.part_of(config.num_scenes)
    workers = max(1, workers // parallel.num_ranks)
    chunks = [numbers[start : start + _CHUNK] for start in range(0, len(numbers), _CHUNK)]
    job = partial(_pairs_of_scenes, tuple(tasks), config, seed, assets, second_view)
    say = report and (lambda done: report(done, len(numbers), "rendering scenes"))
    found = {chunk.start: rows for chunk, rows in imap_unordered(job, chunks, workers, report=say)}
    pairs = stack_rows([row for chunk in chunks for row in found[chunk.start]])
    return map_tensors(pairs.to(parallel.device), parallel.rows_of_all)


def _pairs_of_scenes(
    tasks: Sequence[str],
    config: PretrainingConfig,
    seed: int,
    assets: str,
    second_view: bool,
    numbers: range,
    count: Callable[..., None],
) -> list[tuple]:
    """Render some scenes; return their pairs, see `pairs_of_scene`."""
    pack = load_assets(assets)
    rasteriser = Rasteriser(RandomAppearanceAssets(pack))
    pools = {task: task_spec(task).pool("train") for task in tasks}
    shades = {name for names in pools.values() for name in names.dragged_textures}
    rows: list[tuple] = []
    for number in numbers:
        task = tasks[number % len(tasks)]
        episode_seed = step_seed(seed, "pretraining scene", number)
        episode = sample_episode(task, level="train", seed=episode_seed, domain=_DOMAIN, assets=pack)
        scene = _retexture(episode.problem.scene, pools[task], np.random.default_rng(episode_seed))
        # A generator of its own, so that the scenes below are the same with any augmentation.
        rng = np.random.default_rng([episode_seed, 1])
        if prob := config.appearance_randomization_prob:
            scene = with_random_appearance(scene, prob, rasteriser.assets, rng, config)
        if prob := config.hard_negative_prob:
            scene = with_hard_negatives(scene, prob, shades, rasteriser.assets, rng)
        view = rearrange(scene, rng) if second_view else None
        gray_slots = np.flatnonzero(rng.random(len(scene.placements)) < config.grayscale_prob)
        fills = [fill for _, fill in episode.problem.prompt.images]
        shown = [fill for fill in fills if isinstance(fill, ObjectImage)]
        rows += pairs_of_scene(
            scene,
            {image.placement.object: image.magnification for image in shown},
            rasteriser,
            number,
            view,
            gray_slots=gray_slots,
            with_attributes=config.attribute_loss_weight > 0,
        )
        count(number - numbers.start + 1)
    return rows


def stack_rows(rows: Sequence[tuple]) -> Pairs:
    """Stack the pairs of several scenes, as `pairs_of_scene` returns them, into one record."""
    tensors = [torch.from_numpy(np.stack(column)) for column in zip(*rows, strict=True)]
    labels = tensors[_NUM_COLUMNS:]
    return Pairs(*tensors[:_NUM_COLUMNS], attributes=AttributeLabels(*labels) if labels else None)


def pairs_of_scene(
    scene: Scene,
    magnifications: Mapping[str, float],
    rasteriser: Rasteriser,
    number: int,
    second_view: tuple[Scene, dict[int, float]] | None = None,
    *,
    gray_slots: Sequence[int] | np.ndarray = (),
    with_attributes: bool = False,
) -> list[tuple]:
    """Render a scene and prompt images of its visible objects.

    Args:
        scene: The scene.
        magnifications: Magnification of prompt images by object name; 1 for others.
        rasteriser: Renders.
        number: Index of the scene.
        second_view: The rearranged scene, and rotations by object id.
        gray_slots: Which objects of the scene have a grayscale prompt image.
        with_attributes: Label what the objects are like; only with a second view.

    Returns:
        For each visible object the fields of `Pairs`, without rotations if there is no second view, and
        those of `AttributeLabels` if it is labelled.
    """
    views = [_observe(scene, rasteriser)]
    if second_view:
        views.append(_observe(second_view[0], rasteriser))
    pairs = []
    for slot, placement in enumerate(scene.placements):
        if not views[0].masks[:, slot].any():
            continue
        is_gray = slot in gray_slots
        shown = replace(placement, texture=NEUTRAL_TEXTURE, scale=NO_SCALE) if is_gray else placement
        magnification = magnifications.get(placement.object, 1.0)
        prompt = rasteriser.prompt(Prompt("{object}", (("object", ObjectImage(shown, magnification)),)))
        in_prompt = observe_prompt_image(prompt.images["object"])
        images = [(in_prompt, 0), *((view, slot) for view in views)]
        # Hard negatives, which come with a second view, may be stretched.
        scale = placement.scale if second_view else ()
        pair = (
            np.stack([image.crops[:, place] for image, place in images]),
            np.stack([image.masks[:, place] for image, place in images]),
            name_id(placement.object, placement.texture, *map(str, scale)),
            np.int64(number),
            name_id(placement.object),
            np.bool_(is_gray),
        )
        if second_view:
            from_prompt = placement.pose.yaw_rad - PROMPT_POSE.yaw_rad
            rotations = np.array([from_prompt, second_view[1][placement.id]], dtype=np.float32)
            if not has_visible_heading(placement.object):
                rotations[:] = np.nan
            pair = (*pair, rotations)
            if with_attributes:
                assets = rasteriser.assets
                labels = (
                    attributes_of_object(shown, assets, is_magnified=magnification != 1),
                    attributes_of_object(placement, assets),
                )
                boxes = np.stack([image.boxes[:, place] for image, place in images])
                pair = (*pair, *map(np.stack, zip(*labels, strict=True)), boxes)
        pairs.append(pair)
    return pairs


def _retexture(scene: Scene, textures: Pool, rng: np.random.Generator) -> Scene:
    """Give every object a training texture; few different ones, so that many differ in shape alone.

    Movable objects get textures of dragged objects and fixed ones those of bases, so that the combinations
    of level L2, in which the two sets are swapped, stay unseen.
    """
    size = max(2, len(scene.placements) - 1)
    palettes = {
        fixed: rng.choice(names, size=min(size, len(names)), replace=False) if names else ()
        for fixed, names in ((False, textures.dragged_textures), (True, textures.base_textures))
    }
    placements = [
        replace(p, texture=str(rng.choice(palettes[p.fixed]))) if len(palettes[p.fixed]) else p
        for p in scene.placements
    ]
    return replace(scene, placements=tuple(placements))


def _observe(scene: Scene, rasteriser: Rasteriser) -> ObjectViews:
    views = rasteriser.scene(scene)
    rgb = {name: image.rgb for name, image in views.items()}
    segm = {name: image.segm for name, image in views.items()}
    return extract_objects(rgb, segm, [placement.id for placement in scene.placements])
