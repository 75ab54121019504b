"""Rasteriser of scenes and prompts: colours, object ids and depth, bit-identical on every machine."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from openvima.catalog.geometry import Assets, TriangleMesh
from openvima.errors import ShapeError
from openvima.render.camera import CAMERAS, VIEWS, Camera, View, channels_first, channels_last
from openvima.render.kernels import (
    MICROMETRES,
    draw_triangles,
    index_mesh,
    magnify,
    matrix_3x4,
)
from openvima.scene import (
    BACKGROUND_ID,
    FLOOR_ID,
    SHEET_ID,
    ObjectRecord,
    PhotoImage,
    Placement,
    Pose,
    Prompt,
    PromptFill,
    PromptImage,
    RenderedPrompt,
    Scene,
    SceneImage,
)

FLOOR_Z = -0.001  # m; the sheet is 1 mm above the floor on which bodies rest
FLOOR_RGB = (255, 255, 255)
SHEET_RGB = (51, 51, 51)
SHEET_SIZE = (0.501, 0.999)  # m, x and y, about (0.5, 0)
PROMPT_POSE = Pose.planar(0.5, 0.0, math.pi / 2)  # pose of the object in object images
PHOTO_WHITE = 245  # a pixel of a photo belongs to the object if a channel is below
PHOTO_CENTRES = {"front": (128, 76), "top": (128, 63)}  # column, row of the objects of object images
PHOTO_OBJECT, PHOTO_TEXTURE = "photo", "unknown"  # names in the record of a photo
LARGEST_ID = 254  # 255 is background

Rgb = tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Drawable:
    """A mesh outside the catalogue, such as a link of the arm.

    Args:
        mesh: The triangles.
        pose: World from mesh frame.
        id: Value of its pixels in segmentation images.
        texture: Image, shape (H, W, 3), uint8, row 0 on top; or one colour, 0 to 255.
    """

    mesh: TriangleMesh
    pose: Pose
    id: int
    texture: np.ndarray | Rgb


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """An image of one camera.

    Args:
        rgb: Colours, shape (3, H, W), uint8, row 0 on top.
        segm: Object ids, shape (H, W), uint8; 0 floor, 1 sheet, 255 background.
        depth: Metres from the camera plane, along the optical axis, shape (H, W), float32; infinite for
            background. None unless requested.
    """

    rgb: np.ndarray
    segm: np.ndarray
    depth: np.ndarray | None = None


class Rasteriser:
    """Draws scenes and prompts with one asset pack.

    Directional light, no shadows, no anti-aliasing: with the original asset pack, the pixels of VIMA-Bench.

    Args:
        assets: Asset pack.
    """

    def __init__(self, assets: Assets) -> None:
        self.assets = assets

    def scene(
        self,
        scene: Scene,
        *,
        views: Sequence[View] = VIEWS,
        depth: bool = False,
        extra: Sequence[Drawable] = (),
        enlarge: int = 1,
    ) -> dict[View, Image]:
        """Render a scene on the table.

        Args:
            scene: The scene; of coinciding surfaces, the larger id is visible.
            views: Cameras, in the order of the result.
            depth: Whether to return depth images too.
            extra: Further bodies, drawn before the objects.
            enlarge: Factor on the resolution of 128 × 256 pixels, for videos.

        Returns:
            View name to image.

        Raises:
            UnknownNameError, AssetError: An object has no shape or texture.
            ShapeError: An id is out of range, or a texture malformed.
            ConfigError: `enlarge` is below 1.
        """
        bodies = [*extra, *(self._drawable(placement) for placement in scene.placements)]
        return self._draw(bodies, views, depth=depth, enlarge=enlarge, table=True)

    def prompt(self, prompt: Prompt) -> RenderedPrompt:
        """Render all images of a prompt in both views.

        Raises:
            UnknownNameError, AssetError: An object has no shape or texture.
        """
        images = {name: self._prompt_image(name, fill) for name, fill in prompt.images}
        return RenderedPrompt(prompt.text, images)

    def _prompt_image(self, name: str, fill: PromptFill) -> PromptImage:
        if isinstance(fill, PhotoImage):
            return _photo_image(name, fill)
        if isinstance(fill, SceneImage):
            kind, placements, magnification = "scene", fill.scene.placements, 1.0
        else:
            kind, magnification = "object", fill.magnification
            placements = (replace(fill.placement, id=0, pose=PROMPT_POSE),)
        bodies = [self._drawable(placement, magnification) for placement in placements]
        drawn = self._draw(bodies, VIEWS, table=kind == "scene")
        rgb, segm = (
            {view: getattr(image, part) for view, image in drawn.items()} for part in ("rgb", "segm")
        )
        records = tuple(ObjectRecord(each.id, each.object, each.texture) for each in placements)
        return PromptImage(name, kind, rgb, segm, records)

    def _drawable(self, placement: Placement, magnification: float = 1.0) -> Drawable:
        mesh = placement.geometry(self.assets).visual
        return Drawable(
            mesh if magnification == 1 else magnify(mesh, magnification),
            placement.pose,
            placement.id,
            self.assets.texture(placement.texture),
        )

    def _draw(
        self,
        bodies: Sequence[Drawable],
        views: Sequence[View],
        *,
        table: bool,
        depth: bool = False,
        enlarge: int = 1,
    ) -> dict[View, Image]:
        prepared = [_prepare(body) for body in bodies]
        images: dict[View, Image] = {}
        for view in views:
            empty = _empty_canvas(CAMERAS[view].enlarged(enlarge), table)
            canvas = _Canvas(empty.camera, empty.rgb.copy(), empty.segm.copy(), empty.depth.copy())
            for body in prepared:
                draw_triangles(*body, *canvas)
            distances = _distances(canvas.depth, CAMERAS[view]) if depth else None
            images[view] = Image(canvas.rgb, canvas.segm, distances)
        return images


class _Canvas(NamedTuple):
    """Camera matrix, and the images of one view that bodies are drawn into."""

    camera: np.ndarray
    rgb: np.ndarray
    segm: np.ndarray
    depth: np.ndarray


def _photo_image(name: str, fill: PhotoImage) -> PromptImage:
    """Put a photo into both views where the objects of object images are."""
    pixels, rgb, segm = fill.pixels(), {}, {}
    is_object = (pixels < PHOTO_WHITE).any(axis=2)
    for view in VIEWS:
        camera = CAMERAS[view]
        column, row = PHOTO_CENTRES[view]
        upper, left = row - fill.height // 2, column - fill.width // 2
        window = slice(upper, upper + fill.height), slice(left, left + fill.width)
        rgb[view] = np.full((3, camera.height, camera.width), 255, np.uint8)
        rgb[view][:, *window] = channels_first(pixels)
        segm[view] = np.full((camera.height, camera.width), BACKGROUND_ID, np.uint8)
        segm[view][window][is_object] = 0
    return PromptImage(name, "object", rgb, segm, (ObjectRecord(0, PHOTO_OBJECT, PHOTO_TEXTURE),))


def _prepare(body: Drawable) -> tuple[Any, ...]:
    """Return what `draw_triangles` takes of a body."""
    if not 0 <= body.id <= LARGEST_ID:
        raise ShapeError(f"object id {body.id} does not fit a segmentation image; use 0 to {LARGEST_ID}.")
    mesh = index_mesh(body.mesh)
    arrays = (mesh.vertices, mesh.corners, mesh.normals, mesh.uvs, mesh.is_flat)
    return *arrays, matrix_3x4(body.pose), _texture_array(body.texture), body.id


@lru_cache(maxsize=16)
def _empty_canvas(camera: Camera, table: bool) -> _Canvas:
    shape = (camera.height, camera.width)
    canvas = _Canvas(
        camera.matrix(),
        np.full((3, *shape), 255, dtype=np.uint8),
        np.full(shape, BACKGROUND_ID, dtype=np.uint8),
        np.full(shape, np.inf),
    )
    if table:
        floor = Drawable(_rectangle(200.0, 200.0), Pose((0.0, 0.0, FLOOR_Z)), FLOOR_ID, FLOOR_RGB)
        sheet = Drawable(_rectangle(*SHEET_SIZE), Pose((0.5, 0.0, 0.0)), SHEET_ID, SHEET_RGB)
        for body in (floor, sheet):
            draw_triangles(*_prepare(body), *canvas)
    return canvas


def _distances(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Metres from the camera plane, float32, of what `project_vertices` calls depth."""
    far = camera.away[3]  # depth is MICROMETRES · far · (distance - far) / distance
    with np.errstate(invalid="ignore"):
        distances = far * far / (far - depth / MICROMETRES)
    return np.where(np.isinf(depth), np.inf, distances).astype(np.float32)


def _rectangle(length_x: float, length_y: float) -> TriangleMesh:
    x, y = length_x / 2, length_y / 2
    a, b, c, d = (-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)
    vertices = np.array([[a, b, c], [a, c, d]])
    return TriangleMesh(vertices, np.broadcast_to([0.0, 0.0, 1.0], (2, 3, 3)), np.zeros((2, 3, 2)))


def _texture_array(texture: np.ndarray | Rgb) -> np.ndarray:
    """The texture as a read-only array, for which the kernels are compiled."""
    if isinstance(texture, tuple):
        texture = np.array(texture, dtype=np.uint8).reshape(1, 1, 3)
    if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] != 3 or texture.size == 0:
        raise ShapeError(f"texture is {texture.dtype} of shape {texture.shape}; it must be uint8 (H, W, 3).")
    array = np.ascontiguousarray(texture).view()
    array.setflags(write=False)
    return array


def front_above_top(images: Mapping[View, Image]) -> np.ndarray:
    """Return the colours of both views in one image, the front view above, shape (2 · H, W, 3), uint8."""
    return np.concatenate([channels_last(images[view].rgb) for view in VIEWS])
