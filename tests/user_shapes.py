"""Assets of users for tests: functions for `--assets`."""

import contextlib
from collections.abc import Iterator

import numpy as np

from openvima.catalog import load_assets, register_object, register_texture, registration

CORNERS = np.array([(x, y, z) for x in (0, 3) for y in (0, 2) for z in (0, 1)])
TRIANGLES = np.array(
    [
        *((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)),
        *((2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)),
    ]
)


@contextlib.contextmanager
def restored_assets() -> Iterator[None]:
    """Forget at the end of a block what it registered."""
    tables = (registration._CONTENTS, registration.REGISTERED_OBJECTS, registration.REGISTERED_TEXTURES)
    before = [dict(table) for table in tables]
    try:
        yield
    finally:
        for table, content in zip(tables, before, strict=True):
            table.clear()
            table.update(content)


def boxes(*bounds):
    """Return one mesh of separate boxes, each given by its lower and its upper corner."""
    corners = [np.array(low) + (np.array(high) - low) * (CORNERS > 0) for low, high in bounds]
    triangles = [TRIANGLES + len(CORNERS) * number for number in range(len(bounds))]
    return np.concatenate(corners), np.concatenate(triangles)


def bar():
    """Register an object and a texture."""
    register_object("test bar", (CORNERS, TRIANGLES), size=(0.12, 0.08, 0.04))
    register_texture("test gradient", np.arange(192, dtype=np.uint8).reshape(8, 8, 3))


def pack():
    """Return a pack."""
    return load_assets()


def number():
    """Return what is no pack."""
    return 3
