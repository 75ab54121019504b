"""Shapes of asset packs: triangle meshes and convex collision shapes."""

import itertools
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

Vector3 = tuple[float, float, float]


def product(size: Vector3, scale: Vector3) -> Vector3:
    """Multiply sizes by factors, axis by axis."""
    return (size[0] * scale[0], size[1] * scale[1], size[2] * scale[2])


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """Triangles in the link frame.

    Args:
        vertices: Corner positions in metres, shape (F, 3, 3): triangle, corner, xyz; float64.
            Counter-clockwise seen from outside.
        normals: Unit vertex normals, same shape, float64.
        uvs: Texture coordinates in [0, 1], v = 0 at the bottom row of the image, shape (F, 3, 2), float64.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray


@dataclass(frozen=True, slots=True)
class CollisionBox:
    """A box in the link frame, axes along the frame's.

    Args:
        half_size: Half extents in metres.
        centre: Centre in metres.
    """

    half_size: Vector3
    centre: Vector3 = (0.0, 0.0, 0.0)

    @property
    def points(self) -> np.ndarray:
        """Its corners, shape (8, 3)."""
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
        return np.array(self.centre) + signs * self.half_size


@dataclass(frozen=True, slots=True, eq=False)
class CollisionHull:
    """The convex hull of points in the link frame.

    Args:
        points: Shape (N, 3), float64, metres.
    """

    points: np.ndarray


CollisionShape = CollisionBox | CollisionHull


@dataclass(frozen=True, slots=True, eq=False)
class Geometry:
    """The shape of one object of one size.

    Args:
        visual: Triangles to draw.
        collision: Convex parts; empty for objects without collision (line, three-sided rectangle).
        rest_z_m: Height of the link frame of the object at rest on the table.
    """

    visual: TriangleMesh
    collision: tuple[CollisionShape, ...] = ()
    rest_z_m: float = 0.0


def protect(geometry: Geometry) -> Geometry:
    """Make the arrays of a shared shape read-only, and return it."""
    mesh = geometry.visual
    points = [shape.points for shape in geometry.collision if isinstance(shape, CollisionHull)]
    for array in (mesh.vertices, mesh.normals, mesh.uvs, *points):
        array.setflags(write=False)
    return geometry


@runtime_checkable
class Assets(Protocol):
    """A pack of shapes and textures.

    Results are cached and read-only.
    """

    @property
    def name(self) -> str:
        """Name of the pack, such as "procedural" or "original"."""
        ...

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return the shape of a catalogue object.

        Args:
            object_name: Display name.
            size: Sampled nominal size in metres.
            scale: Factor per axis on top of it.

        Raises:
            UnknownNameError: The catalogue has no such object.
            AssetError: The pack lacks a file for it.
        """
        ...

    def texture(self, texture_name: str) -> np.ndarray:
        """Return the texture's image, shape (H, W, 3), uint8, row 0 on top; plain colours are 1 × 1.

        Raises:
            UnknownNameError: The catalogue has no such texture.
            AssetError: The pack lacks a file for it.
        """
        ...
