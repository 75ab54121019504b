"""Rendering: fixed cameras, a triangle rasteriser, and the label raster of the table."""

from openvima.render.camera import (
    CAMERAS,
    FRONT,
    TOP,
    VIEWS,
    Camera,
    View,
    channels_first,
    channels_last,
    points_from_depth,
    project,
    unproject,
)
from openvima.render.labels import CELL_M, LABEL_SHAPE, cell_centres, empty_labels, label_raster, stamp
from openvima.render.rasteriser import Drawable, Image, Rasteriser

__all__ = [
    "CAMERAS",
    "CELL_M",
    "FRONT",
    "LABEL_SHAPE",
    "TOP",
    "VIEWS",
    "Camera",
    "Drawable",
    "Image",
    "Rasteriser",
    "View",
    "cell_centres",
    "channels_first",
    "channels_last",
    "empty_labels",
    "label_raster",
    "points_from_depth",
    "project",
    "stamp",
    "unproject",
]
