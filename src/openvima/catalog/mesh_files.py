"""Meshes of users and of the original pack: OBJ files and arrays, checked and centred.

Meshes of users come from files and code that nobody has reviewed.
"""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from openvima.catalog.geometry import CollisionHull, Geometry, TriangleMesh, Vector3
from openvima.catalog.meshes import TEXTURE_PER_M, combine, scale_mesh
from openvima.errors import AssetError, InputFileError, ShapeError
from openvima.input_files import as_path, read_text


@dataclass(frozen=True, slots=True, eq=False)
class ObjMesh(TriangleMesh):
    """The faces of a file as triangles, in the file's order.

    Args:
        vertices: Shape (F, 3, 3), float64: triangle, corner, xyz.
        normals: Same shape; of the triangle where the file gives none.
        uvs: Shape (F, 3, 2), float64; 0 where the file gives none.
        parts: Number of the named object ("o" line) that each triangle is part of, shape (F,), int32.
    """

    parts: np.ndarray

    def pieces(self) -> list[np.ndarray]:
        """Return the points of each part, shape (N, 3)."""
        return [self.vertices[self.parts == part].reshape(-1, 3) for part in np.unique(self.parts)]


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
        v, vt, vn = np.moveaxis(np.array(faces), -1, 0)
        vertices = np.array(numbers["v"], dtype=np.float64)[v]
        normals = _look_up(numbers["vn"], vn, otherwise=face_normals(vertices))
        uvs = _look_up(numbers["vt"], vt, otherwise=np.zeros((*vt.shape, 2)))
    except (IndexError, ValueError) as error:
        raise AssetError(f"{name} is damaged: {error}; restore the file.") from error
    return ObjMesh(vertices, normals, uvs, np.array(parts, dtype=np.int32))


def _corner(word: str, counts: tuple[int, int, int]) -> tuple[int, int, int]:
    """Zero-based indices of vertex, texture coordinate and normal; −1 where there is none."""
    fields = word.split("/")
    indices = [int(field) if field else 0 for field in fields] + [0] * (3 - len(fields))
    # Files count from 1, or backwards from the newest entry with negative numbers.
    v, vt, vn = (i - 1 if i >= 0 else n + i for i, n in zip(indices, counts, strict=True))
    if v < 0:
        raise ValueError(f"no vertex {indices[0]}")
    return v, vt, vn


def _look_up(numbers: list[list[float]], indices: np.ndarray, *, otherwise: np.ndarray) -> np.ndarray:
    """Take what the file gives at the corners whose index is not negative."""
    if not numbers:
        return otherwise
    return np.where(indices[..., None] >= 0, np.array(numbers, dtype=np.float64)[indices], otherwise)


def face_normals(vertices: np.ndarray) -> np.ndarray:
    """Return each triangle's unit normal at its three corners; both arrays have shape (F, 3, 3).

    A triangle without area gets the zero vector.
    """
    edges = vertices[:, 1:] - vertices[:, :1]
    normals = np.cross(edges[:, 0], edges[:, 1])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    return np.repeat(normals[:, np.newaxis], 3, axis=1)


MAX_TRIANGLES = 20_000
MAX_OBJ_BYTES = 8 << 20
MIN_LENGTH_M, MAX_LENGTH_M = 0.001, 0.4  # of each side; the workspace is 0.5 m × 1 m
MAX_PARTS = 64  # convex parts of a collision body
_MAX_COORDINATE = 1e6  # in a file, of points and textures
_MIN_THICKNESS = 1e-4  # of a body, relative to its length
_MAX_HULL_POINTS = 256
_NUM_DIRECTIONS = 512  # in which a larger hull keeps its farthest points

Mesh: TypeAlias = str | Path | tuple[np.ndarray, np.ndarray]
"""An OBJ file, or vertices, shape (V, 3), and triangles, shape (F, 3), as indices into them."""


@dataclass(frozen=True, slots=True, eq=False)
class UserMesh:
    """A checked mesh whose bounding box is centred on the origin.

    Args:
        visual: Triangles, in the units of the source.
        extents: Lengths of the bounding box.
        parts: Points of each convex part of the collision body, shape (N, 3).
    """

    visual: TriangleMesh
    extents: Vector3
    parts: tuple[np.ndarray, ...]

    def geometry(self, lengths: Vector3) -> Geometry:
        """Return the shape with sides of some lengths, in metres; the origin is the middle of the box."""
        x, y, z = (length / extent for length, extent in zip(lengths, self.extents, strict=True))
        visual = _drape(scale_mesh(self.visual, (x, y, z)))
        hulls = tuple(CollisionHull(points * (x, y, z)) for points in self.parts)
        return Geometry(visual, hulls, lengths[2] / 2)


def read_mesh(
    mesh: Mesh, collision: Mesh | None = None, *, double_sided: bool = False, what: str
) -> UserMesh:
    """Read and check a mesh.

    Args:
        mesh: What is drawn: counter-clockwise triangles seen from outside, z up.
        collision: Convex parts, in the same coordinates: the separate pieces of another mesh (named objects
            of an OBJ file, or triangles without common vertices). None: the convex hull of `mesh`.
        double_sided: Draw both sides of an open mesh.
        what: The object, for errors.

    Raises:
        ShapeError: Arrays have a wrong shape or dtype.
        AssetError: The mesh cannot be read, or is empty, too large, not finite, flat or open.
    """
    drawn = _read(mesh, what)
    inside_out = TriangleMesh(drawn.vertices[:, ::-1], -drawn.normals[:, ::-1], drawn.uvs[:, ::-1])
    if double_sided:
        drawn = combine([drawn, inside_out])
    elif _faces_inwards(drawn.vertices, what):
        drawn = inside_out
    vertices = drawn.vertices
    corners = vertices.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    _check_thickness(corners, what)
    parts = [corners] if collision is None else _read(collision, f"collision of {what}").pieces()
    if len(parts) > MAX_PARTS:
        raise AssetError(f"collision of {what} has {len(parts)} parts; at most {MAX_PARTS} are allowed.")
    middle = (low + high) / 2
    for number, part in enumerate(parts):
        _check_thickness(part, what if collision is None else f"part {number} of the collision of {what}")
        if (np.abs(part - middle) > (high - low)).any():
            raise AssetError(
                f"part {number} of the collision of {what} is outside twice the mesh's bounds; "
                "use the same coordinates for both."
            )
    seen = face_normals(vertices).any(axis=(1, 2))  # those with an area
    visual = TriangleMesh(vertices[seen] - middle, drawn.normals[seen], drawn.uvs[seen])
    x, y, z = (high - low).tolist()
    return UserMesh(visual, (x, y, z), tuple(_extreme_points(part - middle) for part in parts))


def check_lengths(lengths: Vector3, what: str) -> Vector3:
    """Return three side lengths as numbers.

    Raises:
        AssetError: One is no number, or out of bounds.
    """
    try:
        x, y, z = (float(length) for length in lengths)
    except (TypeError, ValueError):
        raise AssetError(f"size of {what} is {lengths!r:.80}; give three lengths in metres.") from None
    if not all(MIN_LENGTH_M <= length <= MAX_LENGTH_M for length in (x, y, z)):
        raise AssetError(
            f"size of {what} is {x:g} × {y:g} × {z:g} m; each side must lie within {MIN_LENGTH_M:g} … "
            f"{MAX_LENGTH_M:g} m. Is the mesh in metres? `size` scales it."
        )
    return x, y, z


def _read(mesh: Mesh, what: str) -> ObjMesh:
    """Read triangles; `parts` numbers the separate pieces."""
    found = _read_file(as_path(mesh), what) if isinstance(mesh, str | Path) else _from_arrays(mesh, what)
    if not 4 <= len(found.vertices) <= MAX_TRIANGLES:
        raise AssetError(
            f"mesh of {what} has {len(found.vertices)} triangles; 4 … {MAX_TRIANGLES} are allowed."
        )
    coordinates = (found.vertices, found.uvs)
    if not all((np.abs(each) <= _MAX_COORDINATE).all() for each in coordinates):  # NaN fails too
        raise AssetError(
            f"mesh of {what} has a coordinate that is not finite or beyond ±{_MAX_COORDINATE:g}."
        )
    lengths, flat = np.linalg.norm(found.normals, axis=2, keepdims=True), face_normals(found.vertices)
    is_usable = np.isfinite(lengths) & (lengths > 0)
    return replace(found, normals=np.divide(found.normals, lengths, out=flat, where=is_usable))


def _read_file(file: Path, what: str) -> ObjMesh:
    try:
        return parse_obj(read_text(file, max_bytes=MAX_OBJ_BYTES), str(file))
    except OSError as error:
        raise AssetError(f"mesh of {what}: {file} cannot be read ({error.strerror}).") from None
    except InputFileError as error:
        raise AssetError(f"mesh of {what}: {error}") from None


def _from_arrays(mesh: object, what: str) -> ObjMesh:
    form = "give an OBJ file, or (vertices, triangles) of shapes (V, 3), numbers, and (F, 3), whole numbers"
    if not isinstance(mesh, tuple | list) or len(mesh) != 2:
        raise ShapeError(f"mesh of {what} is a {type(mesh).__name__}; {form}.")
    vertices, triangles = np.asarray(mesh[0]), np.asarray(mesh[1])
    for name, array, kinds in (("vertices", vertices, "fiu"), ("triangles", triangles, "iu")):
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in kinds:
            raise ShapeError(f"{name} of {what} are {array.dtype} of shape {array.shape}; {form}.")
    if len(triangles) and not (triangles.min() >= 0 and triangles.max() < len(vertices)):
        raise AssetError(
            f"triangles of {what} name vertices {triangles.min()} … {triangles.max()}; it has 0 … "
            f"{len(vertices) - 1}."
        )
    corners = vertices.astype(np.float64)[triangles.astype(np.int64)]
    with np.errstate(invalid="ignore", over="ignore"):  # `_read` refuses what is not finite
        normals = face_normals(corners)
    return ObjMesh(corners, normals, np.zeros((len(corners), 3, 2)), _pieces(triangles, len(vertices)))


def _pieces(triangles: np.ndarray, num_vertices: int) -> np.ndarray:
    """Number the groups of triangles that share vertices, shape (F,), int32.

    Each round gives all vertices of a triangle its lowest label, then follows labels to labels
    (`lower[lower]`), which halves the way to the lowest one: few rounds even for a long chain of triangles.
    """
    label = np.arange(num_vertices)
    while True:
        lowest = label[triangles].min(axis=1, initial=num_vertices)
        lower = label.copy()
        np.minimum.at(lower, triangles.reshape(-1), np.repeat(lowest, 3))
        lower = lower[lower]
        if (lower == label).all():
            return label[triangles[:, 0]].astype(np.int32)
        label = lower


def _faces_inwards(vertices: np.ndarray, what: str) -> bool:
    """Whether the triangles of a closed mesh face inwards.

    In a closed mesh each edge, from start to end, has its reverse in a neighbour. Six times its volume is a
    sum over the triangles, negative where they face inwards.

    Raises:
        AssetError: The mesh is open, or its triangles are wound inconsistently.
    """
    _, corner = np.unique(np.round(vertices.reshape(-1, 3), 9), axis=0, return_inverse=True)
    corner = corner.reshape(-1, 3).astype(np.int64)
    start, end = corner.reshape(-1), np.roll(corner, -1, axis=1).reshape(-1)
    start, end = start[start != end], end[start != end]
    count = int(corner.max()) + 1
    edges, reverse = start * count + end, end * count + start
    if not np.array_equal(np.sort(edges), np.sort(reverse)):
        raise AssetError(
            f"mesh of {what} is open or has inverted triangles, and triangles are drawn from outside only. "
            "Repair it, or pass double_sided=True."
        )
    middle = vertices.reshape(-1, 3).mean(axis=0)
    a, b, c = np.moveaxis(vertices - middle, 1, 0)
    return bool((a * np.cross(b, c)).sum() < 0)


def _check_thickness(points: np.ndarray, what: str) -> None:
    spread = np.linalg.svd(np.cov(points.T), compute_uv=False)  # squared lengths along the principal axes
    if not spread[2] > _MIN_THICKNESS**2 * spread[0]:
        raise AssetError(f"{what} is flat: all of its vertices lie in a plane; give it a thickness.")


def _extreme_points(points: np.ndarray) -> np.ndarray:
    """Drop repeated points, and most of those inside the hull of a large part."""
    points = np.unique(points, axis=0)
    if len(points) <= _MAX_HULL_POINTS:
        return points
    step = np.arange(_NUM_DIRECTIONS) + 0.5
    z, turn = 1 - 2 * step / _NUM_DIRECTIONS, step * np.pi * (1 + 5**0.5)  # Fibonacci sphere
    radius = np.sqrt(1 - z * z)
    directions = np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)
    return points[np.unique([(points * each).sum(axis=1).argmax() for each in directions])]


def _drape(mesh: TriangleMesh) -> TriangleMesh:
    """Drape the texture over a mesh from above, unless it has texture coordinates."""
    if mesh.uvs.any():
        return mesh
    normals = face_normals(mesh.vertices)
    drop = mesh.vertices[..., 2].max() - mesh.vertices[..., 2]
    flat = mesh.vertices[..., :2] + drop[..., None] * normals[..., :2]
    density = min(TEXTURE_PER_M, 0.5 / max(float(np.abs(flat).max()), 1e-9))
    return TriangleMesh(mesh.vertices, mesh.normals, 0.5 + density * flat)
