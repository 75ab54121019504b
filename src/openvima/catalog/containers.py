"""The two round containers, bowl and pan: visual meshes and collision shapes."""

import math

import numpy as np

from openvima.catalog.geometry import CollisionHull, CollisionShape, TriangleMesh
from openvima.catalog.meshes import combined, prism, revolved, sheared_up
from openvima.catalog.outlines import arc
from openvima.catalog.triangulation import signed_area

_BOWL_SIDES = 26
_BOWL_WALL_PARTS = 13  # with the floor 14 convex parts
_BOWL_FLOOR_Z = 0.009
_BOWL_RIM_Z = 0.0692
_BOWL_BOTTOM = ((0.0, 0.0002), (0.0797, 0.0002))
_BOWL_WALL = (
    (0.0797, 0.0002),
    (0.0872, 0.0300),
    (0.0925, 0.0570),
    (0.0995, 0.0640),
    (0.0998, 0.0685),
    (0.0965, _BOWL_RIM_Z),
    (0.0915, 0.0670),
    (0.0860, 0.0550),
    (0.0790, 0.0280),
    (0.0690, 0.0115),
    (0.0560, _BOWL_FLOOR_Z),
    (0.0, _BOWL_FLOOR_Z),
)
_BOWL_TEXTURE_PER_M = 2.9  # the outer wall reaches the edge of the image

_PAN_SIDES = 30
_PAN_BOTTOM = ((0.0, -0.0138), (0.0650, -0.0138))
_PAN_DISH = (
    (0.0650, -0.0138),
    (0.0765, -0.0055),
    (0.0835, 0.0125),
    (0.0845, 0.0140),
    (0.0815, 0.0135),
    (0.0745, -0.0035),
    (0.0640, -0.0112),
    (0.0590, -0.0112),
    (0.0, -0.0112),
)
_PAN_HANDLE_LOW = (0.0780, 0.0065)  # x, and height of its upper face there
_PAN_HANDLE_HIGH = (0.2082, 0.0275)
_PAN_HANDLE_THICKNESS = 0.0055
_PAN_TEXTURE_PER_M = 2.3  # the tip of the handle is just inside the image


def bowl_mesh() -> TriangleMesh:
    """Return the mesh of the bowl; its axis is the z axis (beside it in the original pack)."""
    outside = [_rim_distance(radius, z) for radius, z in _BOWL_WALL[:5]]
    inside = [radius for radius, _ in _BOWL_WALL[5:]]
    wall_radii = [_BOWL_TEXTURE_PER_M * distance for distance in (*outside, *inside)]
    bottom_radii = [_BOWL_TEXTURE_PER_M * radius for radius, _ in _BOWL_BOTTOM]
    return combined(
        [
            revolved(_BOWL_BOTTOM, _BOWL_SIDES, texture_radii=bottom_radii),
            revolved(_BOWL_WALL, _BOWL_SIDES, texture_radii=wall_radii),
        ]
    )


def _rim_distance(radius: float, z: float) -> float:
    """Distance from the bowl's axis to a point of its outer wall along a cloth draped over it, in metres."""
    return radius + 0.7 * (_BOWL_RIM_Z - z)


def bowl_collision() -> tuple[CollisionShape, ...]:
    """Return a floor disc and a ring of wall parts, each convex."""
    angles = 2 * math.pi * np.arange(_BOWL_WALL_PARTS + 1) / _BOWL_WALL_PARTS
    around = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 9)
    # Chords of the inner circle cut corners: stretch the inner radius so that the flat faces touch it.
    reach = 1 / math.cos(math.pi / _BOWL_WALL_PARTS)
    low, high = 0.0, _BOWL_RIM_Z
    floor_heights = (low, _BOWL_FLOOR_Z - 0.001)  # hulls touch 1 mm away
    floor = [(0.074 * x, 0.074 * y, z) for x, y in around[:-1] for z in floor_heights]
    section = (
        (0.0797, low),
        (0.0690 * reach, low),
        (0.0690 * reach, 0.0115),
        (0.0905 * reach, high),
        (0.1000, high),
    )
    walls = [
        [(r * x, r * y, z) for x, y in around[i : i + 2] for r, z in section] for i in range(_BOWL_WALL_PARTS)
    ]
    return tuple(CollisionHull(np.array(part)) for part in (floor, *walls))


def pan_mesh() -> TriangleMesh:
    """Return the mesh of the pan: a dish about the z axis and a handle along +x with a hole at its end."""
    dish_radii = [_PAN_TEXTURE_PER_M * radius for radius, _ in _PAN_DISH]
    bottom_radii = [_PAN_TEXTURE_PER_M * radius for radius, _ in _PAN_BOTTOM]
    (x_low, z_low), (x_high, z_high) = _PAN_HANDLE_LOW, _PAN_HANDLE_HIGH
    plate = prism(_handle_loops(), z_low - _PAN_HANDLE_THICKNESS, z_low, texture_per_m=_PAN_TEXTURE_PER_M)
    return combined(
        [
            revolved(_PAN_BOTTOM, _PAN_SIDES, texture_radii=bottom_radii),
            revolved(_PAN_DISH, _PAN_SIDES, texture_radii=dish_radii),
            sheared_up(plate, (z_high - z_low) / (x_high - x_low), x_low),
        ]
    )


def _handle_loops() -> list[np.ndarray]:
    """Outline of the handle from above: narrow at the dish, wide and round at its end, with a hole there."""
    x_low, x_high = _PAN_HANDLE_LOW[0], _PAN_HANDLE_HIGH[0]
    half_width = 0.0135
    tip = arc((x_high - half_width, 0.0), (half_width, half_width), (-90, 90), 9)
    neck = [(x_low, -0.0110), (0.100, -0.0085), (0.140, -0.0105)]
    outer = np.round([*neck, *tip, *[(x, -y) for x, y in reversed(neck)]], 6)
    near, far = (
        arc((0.1800, 0.0), (0.0045, 0.0045), (90, 270), 5),
        arc((0.1945, 0.0), (0.0045, 0.0045), (-90, 90), 5),
    )
    hole = np.round([*near, *far], 6)
    return [outer, hole if signed_area(hole) < 0 else hole[::-1]]
