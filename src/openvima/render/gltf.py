"""Meshes with textures as binary glTF, for viewers in 3D."""

from functools import lru_cache

import numpy as np
from PIL import Image

from openvima.catalog.geometry import Assets, TriangleMesh, Vector3
from openvima.imports import import_extra

Shape = tuple[Assets, str, str, Vector3, Vector3]  # of an object: arguments of `object_glb`


@lru_cache(maxsize=256)
def object_glb(assets: Assets, name: str, texture: str, size: Vector3, scale: Vector3) -> bytes:
    """Encode an object of the catalogue with its texture.

    Args:
        assets: Asset pack.
        name: Display name of the object.
        texture: Display name of the texture.
        size: Sampled nominal size in metres.
        scale: Factor per axis on top of it.

    Returns:
        The content of a `.glb` file; its frame is the object's.

    Raises:
        MissingExtraError: trimesh is not installed.
    """
    return _encoded(assets.geometry(name, size, scale).visual, assets.texture(texture))


@lru_cache(maxsize=64)
def coloured_glb(mesh: TriangleMesh, rgb: tuple[int, int, int]) -> bytes:
    """Encode a mesh of one colour, as `object_glb` does."""
    return _encoded(mesh, np.array(rgb, np.uint8).reshape(1, 1, 3))


def _encoded(mesh: TriangleMesh, texture: np.ndarray) -> bytes:
    trimesh = import_extra("trimesh", "glTF needs trimesh; install it with: pip install 'openvima[studio]'")
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(np.ascontiguousarray(texture)),
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    body = trimesh.Trimesh(
        mesh.vertices.reshape(-1, 3),
        np.arange(3 * len(mesh.vertices)).reshape(-1, 3),
        vertex_normals=mesh.normals.reshape(-1, 3),
        visual=trimesh.visual.TextureVisuals(uv=mesh.uvs.reshape(-1, 2), material=material),
        process=False,
    )
    return body.export(file_type="glb", include_normals=True)
