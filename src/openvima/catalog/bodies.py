"""Procedural geometry of each object: visual mesh, collision shapes and rest height.

Dimensions are those of VIMA-Bench. Two poses differ: the bowl is centred on its origin, and the letter T is
upright.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np

from openvima.catalog import boxes
from openvima.catalog.boxes import Box, box_mesh
from openvima.catalog.containers import bowl_collision, bowl_mesh, pan_mesh
from openvima.catalog.geometry import CollisionHull, Geometry, Vector3
from openvima.catalog.hanoi import hanoi_disk, hanoi_stand
from openvima.catalog.meshes import draped, prism, scaled_geometry, slab_hull
from openvima.catalog.objects import ObjectSpec, object_spec
from openvima.catalog.outlines import outline, rectangle
from openvima.errors import AssetError


def build_geometry(object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
    """Build the shape of a catalogue object.

    Args:
        object_name: Display name.
        size: Sampled nominal size in metres; kit objects, bowl, pan, pallet, frame, stand and disk have one
            size and ignore it.
        scale: Factor per axis on top of it.

    Raises:
        UnknownObjectError: The catalogue has no such object.
        AssetError: A size or factor that the object needs is not positive.
    """
    spec = object_spec(object_name)
    if not all(factor > 0 for factor in scale):
        raise AssetError(f"scale of {object_name} is {scale}; all three factors must be above 0.")
    if spec.kind == "kit":
        return scaled_geometry(_kit(spec), scale)
    if object_name in _FIXED_SIZE:
        return scaled_geometry(_FIXED_SIZE[object_name](), scale)
    build, needed_lengths = BOX_SHAPES[object_name]
    product = (size[0] * scale[0], size[1] * scale[1], size[2] * scale[2])
    if not all(length > 0 for length in product[:needed_lengths]):
        raise AssetError(
            f"size of {object_name} is {product} m; its first {needed_lengths} lengths must be above 0."
        )
    geometry = build(product)
    return replace(geometry, visual=draped(geometry.visual))


def has_fixed_size(object_name: str) -> bool:
    """Whether an object's shape ignores the sampled size."""
    return object_spec(object_name).kind == "kit" or object_name in _FIXED_SIZE


@cache  # tasks scale these few shapes by new factors in each episode
def _kit(spec: ObjectSpec) -> Geometry:
    loops = outline(spec.name)
    height = spec.size_max[2] / boxes.HEIGHT_DIVISOR
    return Geometry(prism(loops, 0.0, height), (slab_hull(loops[0], 0.0, height),), 0.0)


def _frame() -> Geometry:
    loops = [np.array(rectangle((0.0, 0.0), (half, half))) for half in (0.09, 0.081)]
    thickness = 0.0015
    visual = prism([loops[0], loops[1][::-1]], 0.0, thickness)
    return Geometry(visual, (slab_hull(loops[0], 0.0, thickness),), rest_z_m=0.0)


def _pallet() -> Geometry:
    """Two decks of seven boards each along y, and three runners along x between them."""
    length, width, height = 0.21, 0.175, 0.02625
    outer, inner, gap, thickness = 0.0245, 0.0175, 0.01225, 0.0035
    parts: list[Box] = []
    left = -length / 2
    for board in (outer, *([inner] * 5), outer):
        parts += [
            Box((board, width, thickness), (left + board / 2, 0.0, side * (height - thickness) / 2))
            for side in (-1, 1)
        ]
        left += board + gap
    parts += [Box((length, 0.007, height - 2 * thickness), (0.0, y, 0.0)) for y in (-0.084, 0.0, 0.084)]
    plan = np.array(rectangle((0.0, 0.0), (length / 2, width / 2)))
    hull = slab_hull(plan, -height / 2, height / 2)
    return Geometry(draped(box_mesh(parts)), (hull,), rest_z_m=height / 2)


def _bowl() -> Geometry:
    return Geometry(bowl_mesh(), bowl_collision(), rest_z_m=0.0)


def _pan() -> Geometry:
    visual = pan_mesh()
    hull = CollisionHull(np.unique(visual.vertices.reshape(-1, 3), axis=0))
    # One hull for dish and handle: objects put into the pan rest on its lid, as in VIMA-Bench.
    return Geometry(visual, (hull,), rest_z_m=float(-visual.vertices[..., 2].min()))


_FIXED_SIZE: dict[str, Callable[[], Geometry]] = {
    "pallet": _pallet,
    "frame": _frame,
    "bowl": _bowl,
    "pan": _pan,
    "stand": hanoi_stand,
    "disk": hanoi_disk,
}
BOX_SHAPES: dict[str, tuple[Callable[[Vector3], Geometry], int]] = {
    "block": (boxes.block, 3),
    "shorter block": (boxes.block, 3),
    "small block": (boxes.block, 3),
    "line": (boxes.line, 2),
    "three-sided rectangle": (boxes.three_sided_rectangle, 2),
    "square": (boxes.square, 2),
    "container": (boxes.container, 3),
}
"""Builders from size times scale, and the number of lengths that they use."""
