"""Slow, obvious twins of the Numba kernels: one point and one triangle at a time, by the definitions."""

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
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours (3, H, W), object ids and heights (H, W) of bodies before a white ground."""
    rgb = np.full((3, camera.height, camera.width), 255, dtype=np.uint8)
    segm = np.full((camera.height, camera.width), 255, dtype=np.uint8)
    heights = np.full((camera.height, camera.width), np.nan, dtype=np.float32)
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
                    heights[row, column] = weights @ world[:, 2]
                    depth[row, column] = distance
    return rgb, segm, heights


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
