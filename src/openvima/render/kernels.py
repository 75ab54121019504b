"""Numba kernels that fill and shade triangles, for a camera or from straight above.

The calling modules check the arguments. Each kernel has a slow reference implementation in the tests.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openvima.catalog.geometry import TriangleMesh
from openvima.compilation import njit
from openvima.scene import Pose

# Direction towards the light, the same in every image: (−50, 30, 100) as a unit vector.
_LIGHT_X = -50.0 / math.sqrt(13400.0)
_LIGHT_Y = 30.0 / math.sqrt(13400.0)
_LIGHT_Z = 100.0 / math.sqrt(13400.0)
AMBIENT, DIFFUSE, SPECULAR = 0.6, 0.35, 0.05
MICROMETRES = 1e6  # in a metre


@njit
def light_intensity(nx: float, ny: float, nz: float) -> float:
    """Brightness factor of a surface with the unit normal (nx, ny, nz) in the world.

    The highlight depends on the height to which light is reflected, not on the viewer: all views agree on it.
    """
    facing = nx * _LIGHT_X + ny * _LIGHT_Y + nz * _LIGHT_Z
    reflected_z = max(0.0, 2.0 * facing * nz - _LIGHT_Z)  # of 2(n·l)n − l, a unit vector as n and l are
    return AMBIENT + DIFFUSE * max(0.0, facing) + SPECULAR * reflected_z * reflected_z


@njit
def texel_index(u: float, v: float, height: int, width: int) -> tuple[int, int]:
    """Row and column of the texel nearest to (u, v); v = 0 is the bottom row, both coordinates wrap at 1."""
    column = int((u - np.floor(u)) * width)
    row = height - 1 - int((v - np.floor(v)) * height)
    return max(row, 0), min(column, width - 1)  # u − floor(u) of a tiny negative u rounds to 1


@njit
def _row_times(matrix: np.ndarray, row: int, x: float, y: float, z: float) -> float:
    """First three entries of a row of a matrix times a vector."""
    return matrix[row, 0] * x + matrix[row, 1] * y + matrix[row, 2] * z


@njit
def _transform(matrix: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """First three rows of a matrix, shape (·, 4), times a point."""
    return (
        _row_times(matrix, 0, x, y, z) + matrix[0, 3],
        _row_times(matrix, 1, x, y, z) + matrix[1, 3],
        _row_times(matrix, 2, x, y, z) + matrix[2, 3],
    )


@njit
def _doubled_area(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> float:
    """Doubled area of a triangle, positive for a left turn."""
    return (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)


@njit
def _interpolate(a: float, b: float, c: float, values: np.ndarray, triangle: int, part: int) -> float:
    """Weigh one of the numbers that the corners of a triangle have, (F, 3, ·)."""
    return a * values[triangle, 0, part] + b * values[triangle, 1, part] + c * values[triangle, 2, part]


@njit
def _corner_points(points: np.ndarray, corners: np.ndarray, triangle: int) -> tuple[float, ...]:
    """Return x, y, z of the corners of a triangle, one after the other."""
    a, b, c = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
    return (
        points[a, 0],
        points[a, 1],
        points[a, 2],
        points[b, 0],
        points[b, 1],
        points[b, 2],
        points[c, 0],
        points[c, 1],
        points[c, 2],
    )


@njit
def project_vertices(
    vertices: np.ndarray,  # (V, 3) float64, body frame
    pose: np.ndarray,  # (3, 4) float64, world from body
    camera: np.ndarray,  # (4, 4) float64, see Camera.matrix
) -> np.ndarray:
    """Return where vertices are on the image plane, (V, 3) float64: X, Y up, depth in micrometres."""
    screen = np.empty(vertices.shape)
    focal, half_width, half_height = camera[3, 0], camera[3, 1], camera[3, 2]
    for i in range(vertices.shape[0]):
        x, y, z = _transform(pose, vertices[i, 0], vertices[i, 1], vertices[i, 2])
        right, up, distance = _transform(camera, x, y, z)
        away = _row_times(camera, 2, x, y, z)
        inverse = 1.0 / distance if distance > 0.0 else math.nan  # NaN fails every comparison: not drawn
        screen[i, 0] = half_width + focal * right * inverse
        screen[i, 1] = half_height + focal * up * inverse
        # Grows with the distance as −1/distance does, so that it is linear on the screen, yet is as good as a
        # length about the middle of the scene: without the constant of 1000 m its digits suffice.
        screen[i, 2] = MICROMETRES * camera[2, 3] * away * inverse
    return screen


@njit
def select_triangles(
    corners: np.ndarray,  # (F, 3) int32, indices into points
    points: np.ndarray,  # (V, 3) float64: across and upwards; the front of triangles turns left
    min_area: float,  # smaller doubled areas are left out
) -> np.ndarray:
    """Return the indices of triangles that show their front and may cover a whole-numbered point, in order.

    Most triangles of a fine mesh do neither. The list is built without branches, which the CPU could not
    predict: that saves a fifth of the time of the largest meshes.
    """
    count, selected = 0, np.empty(corners.shape[0] + 1, np.int32)
    for f in range(corners.shape[0]):
        ax, ay, _, bx, by, _, cx, cy, _ = _corner_points(points, corners, f)
        low_x, high_x = _range_of(ax, bx, cx)
        low_y, high_y = _range_of(ay, by, cy)
        selected[count] = f
        count += (
            (_doubled_area(ax, ay, bx, by, cx, cy) > min_area)
            & (np.ceil(low_x) <= high_x)
            & (np.ceil(low_y) <= high_y)
        )
    return selected[:count]


@njit
def _range_of(a: float, b: float, c: float) -> tuple[float, float]:
    """Smallest and largest of three numbers."""
    low = a if a < b else b
    high = b if a < b else a
    return (c if c < low else low), (c if c > high else high)


@njit
def _whole_numbers_between(a: float, b: float, c: float, last: int) -> tuple[int, int]:
    """First and last whole number from 0 to `last` in the range of a, b, c; none if the first is larger."""
    low, high = _range_of(a, b, c)
    return int(min(max(np.ceil(low), 0.0), last + 1.0)), int(max(min(np.floor(high), float(last)), -1.0))


@njit
def draw_triangles(
    vertices: np.ndarray,  # (V, 3) float64, body frame
    corners: np.ndarray,  # (F, 3) int32, indices into vertices
    normals: np.ndarray,  # (F, 3, 3) float64, body frame
    uvs: np.ndarray,  # (F, 3, 2) float64
    is_flat: np.ndarray,  # (F,) bool: the corners' normals are equal
    pose: np.ndarray,  # (3, 4) float64, world from body
    texture: np.ndarray,  # (h, w, 3) uint8
    object_id: int,
    camera: np.ndarray,  # (4, 4) float64, see Camera.matrix
    rgb: np.ndarray,  # (3, H, W) uint8
    segm: np.ndarray,  # (H, W) uint8
    depth: np.ndarray,  # (H, W) float64, micrometres, smaller is nearer
) -> None:
    """Draw one body into one image, over what is there already.

    A pixel belongs to a triangle if its sampling point lies inside or on the border; among triangles of equal
    depth the later one shows. Back faces and triangles of next to no area are left out.

    Every pixel of a triangle's bounding box is tested by its three barycentric weights, computed anew:
    stepped from pixel to pixel they would round differently, and pixels on a border would change sides.
    """
    image_height, image_width = segm.shape
    texture_height, texture_width = texture.shape[0], texture.shape[1]
    screen = project_vertices(vertices, pose, camera)
    for f in select_triangles(corners, screen, camera[3, 3]):
        ax, ay, az, bx, by, bz, cx, cy, cz = _corner_points(screen, corners, f)
        inverse_area = 1.0 / _doubled_area(ax, ay, bx, by, cx, cy)
        low_x, high_x = _whole_numbers_between(ax, bx, cx, image_width - 1)
        low_y, high_y = _whole_numbers_between(ay, by, cy, image_height - 1)
        intensity = -1.0
        for j in range(low_y, high_y + 1):
            row = image_height - 1 - j
            for column in range(low_x, high_x + 1):
                weight_a = _doubled_area(column, j, bx, by, cx, cy)
                weight_b = _doubled_area(column, j, cx, cy, ax, ay)
                weight_c = _doubled_area(column, j, ax, ay, bx, by)
                if (weight_a < 0.0) | (weight_b < 0.0) | (weight_c < 0.0):
                    continue
                weight_a *= inverse_area
                weight_b *= inverse_area
                weight_c *= inverse_area
                # Rounded to whole micrometres: surfaces at one height tie whatever triangles they consist of.
                pixel_depth = np.rint(weight_a * az + weight_b * bz + weight_c * cz)
                if pixel_depth > depth[row, column]:
                    continue
                if intensity < 0.0 or not is_flat[f]:
                    nx = _interpolate(weight_a, weight_b, weight_c, normals, f, 0)
                    ny = _interpolate(weight_a, weight_b, weight_c, normals, f, 1)
                    nz = _interpolate(weight_a, weight_b, weight_c, normals, f, 2)
                    length = math.sqrt(nx * nx + ny * ny + nz * nz)
                    if length > 0.0:
                        nx, ny, nz = nx / length, ny / length, nz / length
                    intensity = light_intensity(
                        _row_times(pose, 0, nx, ny, nz),
                        _row_times(pose, 1, nx, ny, nz),
                        _row_times(pose, 2, nx, ny, nz),
                    )
                u = _interpolate(weight_a, weight_b, weight_c, uvs, f, 0)
                v = _interpolate(weight_a, weight_b, weight_c, uvs, f, 1)
                texel_row, texel_column = texel_index(u, v, texture_height, texture_width)
                for channel in range(3):
                    lit = intensity * texture[texel_row, texel_column, channel]
                    rgb[channel, row, column] = np.uint8(min(255.0, lit))
                depth[row, column] = pixel_depth
                segm[row, column] = object_id


@njit
def stamp_triangles(
    vertices: np.ndarray,  # (V, 3) float64, body frame
    corners: np.ndarray,  # (F, 3) int32, indices into vertices
    pose: np.ndarray,  # (3, 4) float64, world from body
    object_id: int,
    origin_x: float,  # x of the centre of column 0, m
    origin_y: float,  # y of the centre of row 0, m
    cell: float,  # m
    ceiling: float,  # surfaces at this height or above are left out, m
    labels: np.ndarray,  # (rows, columns) int16
    heights: np.ndarray,  # (rows, columns) float32
) -> None:
    """Enter one body into a map seen from above: the highest surface over each cell's centre gets its id.

    Of equal heights the later one counts. Rows run along y, columns along x.
    """
    num_rows, num_columns = labels.shape
    points = np.empty(vertices.shape)  # column, row, height
    for i in range(vertices.shape[0]):
        x, y, z = _transform(pose, vertices[i, 0], vertices[i, 1], vertices[i, 2])
        points[i, 0], points[i, 1], points[i, 2] = (x - origin_x) / cell, (y - origin_y) / cell, z

    for f in select_triangles(corners, points, 0.0):
        ax, ay, az, bx, by, bz, cx, cy, cz = _corner_points(points, corners, f)
        inverse_area = 1.0 / _doubled_area(ax, ay, bx, by, cx, cy)
        low_x, high_x = _whole_numbers_between(ax, bx, cx, num_columns - 1)
        low_y, high_y = _whole_numbers_between(ay, by, cy, num_rows - 1)
        for row in range(low_y, high_y + 1):
            for column in range(low_x, high_x + 1):
                weight_a = _doubled_area(column, row, bx, by, cx, cy)
                weight_b = _doubled_area(column, row, cx, cy, ax, ay)
                weight_c = _doubled_area(column, row, ax, ay, bx, by)
                if (weight_a < 0.0) | (weight_b < 0.0) | (weight_c < 0.0):
                    continue
                z = (weight_a * az + weight_b * bz + weight_c * cz) * inverse_area
                height = np.float32(z)
                if z < ceiling and height >= heights[row, column]:
                    heights[row, column] = height
                    labels[row, column] = object_id


MERGE_FROM_TRIANGLES = 400  # below this, merging corners costs more than it saves


@dataclass(frozen=True, slots=True, eq=False)
class IndexedMesh:
    """The triangles of a mesh with shared corners.

    Args:
        vertices: Positions in the body frame, metres, shape (V, 3), float64.
        corners: Triangles as indices into `vertices`, shape (F, 3), int32.
        normals: Unit normals at the corners, shape (F, 3, 3), float64.
        uvs: Texture coordinates at the corners, shape (F, 3, 2), float64.
        is_flat: Whether a triangle's three normals are equal, shape (F,), bool.
        upward: The rows of `corners` that face up while the body is level, shape (U, 3), int32.
    """

    vertices: np.ndarray
    corners: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    is_flat: np.ndarray
    upward: np.ndarray


@lru_cache(maxsize=256)
def index_mesh(mesh: TriangleMesh) -> IndexedMesh:
    """Return a mesh in indexed form; the same mesh object gives the same arrays."""
    num_triangles = len(mesh.vertices)
    flattened = mesh.vertices.reshape(-1, 3)
    if num_triangles >= MERGE_FROM_TRIANGLES:
        vertices, inverse = np.unique(flattened, axis=0, return_inverse=True)
        corners = inverse.reshape(-1, 3)
    else:
        vertices, corners = flattened, np.arange(3 * num_triangles).reshape(-1, 3)
    a, b, c = (mesh.vertices[:, k, :2] for k in range(3))
    doubled_area = (b - a)[:, 0] * (c - a)[:, 1] - (c - a)[:, 0] * (b - a)[:, 1]
    corners = np.ascontiguousarray(corners, dtype=np.int32)
    # Copies: kernels would be compiled again for the read-only arrays of packs.
    return IndexedMesh(
        vertices=np.array(vertices, dtype=np.float64, order="C"),
        corners=corners,
        normals=np.array(mesh.normals, dtype=np.float64, order="C"),
        uvs=np.array(mesh.uvs, dtype=np.float64, order="C"),
        is_flat=(mesh.normals == mesh.normals[:, :1]).all(axis=(1, 2)),
        upward=np.ascontiguousarray(corners[doubled_area > 0]),
    )


@lru_cache(maxsize=64)
def magnify(mesh: TriangleMesh, factor: float) -> TriangleMesh:
    """Return a mesh scaled by `factor` about its origin."""
    return TriangleMesh(mesh.vertices * factor, mesh.normals, mesh.uvs)


def matrix_3x4(pose: Pose) -> np.ndarray:
    """Return a pose as rotation and translation, shape (3, 4), float64."""
    return np.column_stack([pose.matrix(), pose.position])
