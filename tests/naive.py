"""Slow reference implementations for tests: plain loops over pixels, boxes and anchors."""

import heapq
import math

import numpy as np

from openvima.catalog import TriangleMesh
from openvima.render.camera import Camera
from openvima.scene import Pose

LIGHT = np.array([-50.0, 30.0, 100.0]) / np.linalg.norm([-50.0, 30.0, 100.0])


def light_intensity(normal: np.ndarray) -> float:
    facing = float(normal @ LIGHT)
    reflected = 2 * facing * normal - LIGHT
    highlight = max(0.0, reflected[2] / np.linalg.norm(reflected))
    return 0.6 + 0.35 * max(0.0, facing) + 0.05 * highlight**2


def texel(texture: np.ndarray, u: float, v: float) -> np.ndarray:
    height, width, _ = texture.shape
    column = math.floor((u - math.floor(u)) * width)
    row_from_below = math.floor((v - math.floor(v)) * height)
    return texture[height - 1 - row_from_below, column]


def screen_point(point: np.ndarray, camera: Camera) -> tuple[float, float, float]:
    """X, Y upwards in pixels, and the distance from the camera plane."""
    x, y, z = point
    right, up, away = (a * x + b * y + c * z + d for a, b, c, d in (camera.right, camera.up, camera.away))
    return (
        camera.width / 2 + camera.focal_px * right / away,
        camera.height / 2 + camera.focal_px * up / away,
        away,
    )


def cross(origin: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Doubled signed area of a triangle in the plane."""
    return float((a[0] - origin[0]) * (b[1] - origin[1]) - (b[0] - origin[0]) * (a[1] - origin[1]))


def draw(
    bodies: list[tuple[TriangleMesh, Pose, int, np.ndarray]], camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Colours (3, H, W) and object ids (H, W) of bodies before a white ground."""
    rgb = np.full((3, camera.height, camera.width), 255, dtype=np.uint8)
    segm = np.full((camera.height, camera.width), 255, dtype=np.uint8)
    depth = np.full((camera.height, camera.width), np.inf)
    for mesh, pose, object_id, texture in bodies:
        for corners, normals, uvs in zip(mesh.vertices, mesh.normals, mesh.uvs, strict=True):
            world = pose.transform(corners)
            points = np.array([screen_point(corner, camera) for corner in world])
            area = cross(*points)
            if area <= camera.min_doubled_area_px2:
                continue
            for row in range(camera.height):
                for column in range(camera.width):
                    sample = np.array([column, camera.height - 1 - row])
                    a, b, c = points
                    weights = np.array([cross(sample, b, c), cross(sample, c, a), cross(sample, a, b)]) / area
                    distance = round(1e6 / (weights @ (1 / points[:, 2])))  # micrometres
                    if weights.min() < 0 or distance > depth[row, column]:
                        continue
                    normal = weights @ normals
                    intensity = light_intensity(pose.matrix() @ (normal / np.linalg.norm(normal)))
                    colour = texel(texture, *(weights @ uvs))
                    rgb[:, row, column] = np.minimum(255, np.floor(intensity * colour.astype(float)))
                    segm[row, column] = object_id
                    depth[row, column] = distance
    return rgb, segm


def label_cells(
    bodies: list[tuple[TriangleMesh, Pose, int]], rows: range, columns: range
) -> tuple[np.ndarray, np.ndarray]:
    """Topmost object at the centres of some cells of the label raster, and the height of its surface."""
    cell = 0.003125
    labels = np.zeros((len(rows), len(columns)), dtype=np.int16)
    heights = np.zeros((len(rows), len(columns)))
    for mesh, pose, object_id in bodies:
        for corners in pose.transform(mesh.vertices):
            area = cross(*corners)
            if area <= 0:
                continue
            for i, u in enumerate(rows):
                for j, v in enumerate(columns):
                    centre = np.array([0.25 + (v + 0.5) * cell, -0.5 + (u + 0.5) * cell])
                    a, b, c = corners
                    weights = np.array([cross(centre, b, c), cross(centre, c, a), cross(centre, a, b)]) / area
                    z = float(weights @ corners[:, 2])
                    if weights.min() >= 0 and z < 0.3 and z >= heights[i, j] - 1e-9:
                        labels[i, j], heights[i, j] = object_id, z
    return labels, heights


def interleaved(planes: np.ndarray) -> np.ndarray:
    """Images (N, 3, H, W) as pixels (N, H, W, 3)."""
    num_images, _, height, width = planes.shape
    pixels = np.zeros((num_images, height, width, 3), planes.dtype)
    for n, row, column, colour in np.ndindex(pixels.shape):
        pixels[n, row, column, colour] = planes[n, colour, row, column]
    return pixels


CROP = 32


def crop_and_box(rgb: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The resized crop, as real numbers before rounding, and the box of the pixels where `shown` is true."""
    rows, columns = np.nonzero(shown)
    top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
    cut = rgb[:, top : bottom + 1, left : right + 1].astype(float)
    _, height, width = cut.shape
    size = max(height, width)
    before_rows, before_columns = (size - height) // 2, (size - width) // 2
    square = np.zeros((3, size, size))
    square[:, before_rows : before_rows + height, before_columns : before_columns + width] = cut
    weights = shrinking(size) if size >= CROP else enlarging(size)
    crop = np.einsum("iy,cyx,jx->cij", weights, square, weights)
    return crop, np.array([(left + right) // 2, (top + bottom) // 2, bottom - top, right - left])


def shrinking(size: int) -> np.ndarray:
    """Share of each source pixel in each target pixel, shape (32, size)."""
    scale = size / CROP
    weights = np.zeros((CROP, size))
    for target in range(CROP):
        for source in range(size):
            common = min(source + 1, (target + 1) * scale) - max(source, target * scale)
            weights[target, source] = max(0.0, common) / scale
    return weights


def enlarging(size: int) -> np.ndarray:
    """Weights of the two source pixels whose border a target pixel crosses, or of the one that it is in."""
    weights = np.zeros((CROP, size))
    for target in range(CROP):
        source = min(target * size // CROP, size - 1)
        beyond = (target + 1) - (source + 1) * CROP / size  # of the target pixel, over the source's end
        share = max(0.0, beyond) if source + 1 < size else 0.0
        weights[target, source] += 1 - share
        weights[target, min(source + 1, size - 1)] += share
    return weights


def most_interior(shown: np.ndarray) -> tuple[int, int]:
    """Column and row of the pixel farthest from any pixel that is not shown, in 3-4 chamfer steps."""
    padded = np.pad(shown, 1)
    distance = np.where(padded, np.inf, 0.0)
    queue = [(0.0, int(r), int(c)) for r, c in zip(*np.nonzero(~padded), strict=True)]
    heapq.heapify(queue)
    while queue:
        far, row, column = heapq.heappop(queue)
        if far > distance[row, column]:
            continue
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                r, c = row + i, column + j
                inside = 0 <= r < padded.shape[0] and 0 <= c < padded.shape[1]
                step = 4 if i and j else 3
                if (i or j) and inside and far + step < distance[r, c]:
                    distance[r, c] = far + step
                    heapq.heappush(queue, (far + step, r, c))
    rows, columns = np.nonzero(shown)
    count = len(rows)
    candidates = [
        (
            -distance[r + 1, c + 1],
            (count * c - columns.sum()) ** 2 + (count * r - rows.sum()) ** 2,
            int(r),
            int(c),
        )
        for r, c in zip(rows, columns, strict=True)
    ]
    _, _, row, column = min(candidates)
    return column, row


Box = tuple[float, float, float, float]


def box_iou(first: Box, second: Box) -> float:
    """Intersection over union of two boxes."""
    width = min(first[2], second[2]) - max(first[0], second[0])
    height = min(first[3], second[3]) - max(first[1], second[1])
    if width <= 0 or height <= 0:
        return 0.0
    sizes = [(box[2] - box[0]) * (box[3] - box[1]) for box in (first, second)]
    return width * height / (sum(sizes) - width * height)


def nms(boxes: list[Box], scores: list[float], limit: float, groups: list[int]) -> list[int]:
    """Go through the boxes from the best to the worst and keep what overlaps no kept box."""
    kept: list[int] = []
    for number in sorted(range(len(boxes)), key=lambda number: (-scores[number], number)):
        rivals = [other for other in kept if groups[other] == groups[number]]
        if all(box_iou(boxes[other], boxes[number]) <= limit for other in rivals):
            kept.append(number)
    return kept


def anchors(size: float, *, stride: int, height: int, width: int) -> list[Box]:
    """All anchors of a level: rows, cells, then ratios of height to width."""
    found = []
    for row in range(height):
        for column in range(width):
            for ratio in (0.5, 1.0, 2.0):
                half_width = math.sqrt(size * size / ratio) / 2
                half_height = half_width * ratio
                x, y = column * stride, row * stride
                found.append((x - half_width, y - half_height, x + half_width, y + half_height))
    return found


def encode(box: Box, reference: Box, weights: Box) -> list[float]:
    """Shift of the centre and growth of a box, relative to a reference."""
    numbers = []
    for axis in (0, 1):
        extent = reference[axis + 2] - reference[axis]
        middle = (box[axis] + box[axis + 2]) / 2 - (reference[axis] + reference[axis + 2]) / 2
        numbers.append((middle / extent, math.log((box[axis + 2] - box[axis]) / extent)))
    (x, wide), (y, high) = numbers
    return [part * weight for part, weight in zip((x, y, wide, high), weights, strict=True)]


def read_point(image: np.ndarray, x: float, y: float) -> float:
    """Bilinear interpolation in an image (H, W) whose pixels are known at whole numbers."""
    height, width = image.shape
    if x < -1 or x > width or y < -1 or y > height:
        return 0.0
    x, y = min(max(x, 0.0), width - 1.0), min(max(y, 0.0), height - 1.0)
    left, upper = int(x), int(y)
    right, lower = min(left + 1, width - 1), min(upper + 1, height - 1)
    over, under = x - left, y - upper
    above = (1 - over) * image[upper, left] + over * image[upper, right]
    below = (1 - over) * image[lower, left] + over * image[lower, right]
    return float((1 - under) * above + under * below)


def roi_align(image: np.ndarray, box: Box, *, size: int, stride: float, sampling_ratio: int) -> np.ndarray:
    """Averages of an image (H, W) over the cells of a grid inside a box, shape (size, size)."""
    left, upper, right, lower = (edge / stride - 0.5 for edge in box)
    cell_width, cell_height = (right - left) / size, (lower - upper) / size
    columns = sampling_ratio or max(1, math.ceil(cell_width))
    rows = sampling_ratio or max(1, math.ceil(cell_height))
    cells = np.zeros((size, size))
    for row in range(size):
        for column in range(size):
            values = [
                read_point(
                    image,
                    left + (column + (i + 0.5) / columns) * cell_width,
                    upper + (row + (j + 0.5) / rows) * cell_height,
                )
                for j in range(rows)
                for i in range(columns)
            ]
            cells[row, column] = sum(values) / len(values)
    return cells


def paste(probabilities: np.ndarray, box: Box, *, height: int, width: int) -> np.ndarray:
    """Which pixels of an image have their centre inside a mask known at the centres of cells (S, S)."""
    size = len(probabilities)
    padded = np.pad(probabilities, 1)  # nothing lies outside
    inside = np.zeros((height, width), bool)
    for row in range(height):
        for column in range(width):
            x = (column + 0.5 - box[0]) / (box[2] - box[0]) * size - 0.5
            y = (row + 0.5 - box[1]) / (box[3] - box[1]) * size - 0.5
            if -1 < x < size and -1 < y < size:
                inside[row, column] = read_point(padded, x + 1, y + 1) >= 0.5
    return inside
