"""Naive implementations of the detector's operations, in plain Python."""

import math

import numpy as np

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
