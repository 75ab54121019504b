"""Meshes with textures as binary glTF, for viewers in 3D."""

import io

import numpy as np
from PIL import Image

from openvima.catalog.geometry import TriangleMesh
from openvima.extras import import_extra


def encode_glb(mesh: TriangleMesh, texture: np.ndarray) -> bytes:
    """Encode a mesh with its texture.

    Args:
        mesh: The triangles.
        texture: Image, shape (H, W, 3), uint8, row 0 on top.

    Returns:
        The content of a `.glb` file; its frame is the mesh's.

    Raises:
        MissingExtraError: trimesh is not installed.
    """
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
    with io.BytesIO() as stream:
        body.export(stream, file_type="glb", include_normals=True)
        return stream.getvalue()
