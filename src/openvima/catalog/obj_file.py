"""Reader of Wavefront .obj files: triangles with texture coordinates and normals, in the file's units."""

import itertools
from dataclasses import dataclass

import numpy as np

from openvima.errors import AssetError


@dataclass(frozen=True, slots=True, eq=False)
class ObjMesh:
    """The faces of a file as triangles, in the file's order.

    Args:
        vertices: Shape (F, 3, 3), float64: triangle, corner, xyz.
        normals: Same shape; of the triangle where the file gives none.
        uvs: Shape (F, 3, 2), float64; 0 where the file gives none.
        parts: Number of the named object ("o" line) that each triangle is part of, shape (F,), int32.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    parts: np.ndarray

    def to_array(self) -> np.ndarray:
        """Return everything as one array, a row a triangle, shape (F, 25), float64."""
        rows = (self.vertices, self.normals, self.uvs, self.parts)
        return np.concatenate([part.reshape(len(self.parts), -1) for part in rows], axis=1)

    @classmethod
    def from_array(cls, array: np.ndarray) -> "ObjMesh":
        """Invert `to_array`."""
        vertices, normals, uvs, parts = np.split(array, (9, 18, 24), axis=1)
        return cls(
            np.ascontiguousarray(vertices).reshape(-1, 3, 3),
            np.ascontiguousarray(normals).reshape(-1, 3, 3),
            np.ascontiguousarray(uvs).reshape(-1, 3, 2),
            parts[:, 0].astype(np.int32),
        )


def parse_obj(text: str, name: str) -> ObjMesh:
    """Parse the text of an .obj file; materials, smoothing groups and line elements are skipped.

    Args:
        text: The file's content.
        name: Name for errors.

    Raises:
        AssetError: A line cannot be understood, an index has no target, or there is no face.
    """
    numbers: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    faces: list[tuple[tuple[int, int, int], ...]] = []
    parts: list[int] = []
    part = 0
    for line_number, line in enumerate(text.splitlines(), start=1):
        key, _, rest = line.strip().partition(" ")
        try:
            if key in numbers:
                length = 2 if key == "vt" else 3
                values = [float(word) for word in rest.split()[:length]]
                if len(values) < length:
                    raise ValueError(f"{len(values)} numbers instead of {length}")
                numbers[key].append(values)
            elif key == "o":
                part += bool(faces)
            elif key == "f":
                counts = (len(numbers["v"]), len(numbers["vt"]), len(numbers["vn"]))
                corners = [_corner(word, counts) for word in rest.split()]
                for second, third in itertools.pairwise(corners[1:]):
                    faces.append((corners[0], second, third))
                    parts.append(part)
        except ValueError as error:
            raise AssetError(
                f"{name} line {line_number}: cannot read {line.strip()!r} ({error}); restore the file."
            ) from error
    if not faces:
        raise AssetError(f"{name} holds no faces; restore the file.")
    try:
        return _assemble(numbers, np.array(faces), np.array(parts, dtype=np.int32))
    except (IndexError, ValueError) as error:
        raise AssetError(f"{name} is damaged: {error}; restore the file.") from error


def _corner(word: str, counts: tuple[int, int, int]) -> tuple[int, int, int]:
    """Zero-based indices of vertex, texture coordinate and normal; −1 where there is none."""
    fields = word.split("/")
    indices = [int(field) if field else 0 for field in fields] + [0] * (3 - len(fields))
    # Files count from 1, or backwards from the newest entry with negative numbers.
    v, vt, vn = (i - 1 if i >= 0 else n + i for i, n in zip(indices, counts, strict=True))
    if v < 0:
        raise ValueError(f"no vertex {indices[0]}")
    return v, vt, vn


def _assemble(numbers: dict[str, list[list[float]]], faces: np.ndarray, parts: np.ndarray) -> ObjMesh:
    vertices = np.array(numbers["v"], dtype=np.float64)[faces[..., 0]]
    uvs = np.zeros((*faces.shape[:2], 2))
    if numbers["vt"]:
        uvs = np.where(faces[..., 1:2] >= 0, np.array(numbers["vt"], dtype=np.float64)[faces[..., 1]], 0.0)
    normals = face_normals(vertices)
    if numbers["vn"]:
        given = np.array(numbers["vn"], dtype=np.float64)[faces[..., 2]]
        normals = np.where(faces[..., 2:3] >= 0, given, normals)
    return ObjMesh(vertices, normals, uvs, parts)


def face_normals(vertices: np.ndarray) -> np.ndarray:
    """Return each triangle's unit normal at its three corners; both arrays have shape (F, 3, 3).

    A triangle without area gets the zero vector.
    """
    edges = vertices[:, 1:] - vertices[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    return np.repeat(normals[:, np.newaxis], 3, axis=1)
