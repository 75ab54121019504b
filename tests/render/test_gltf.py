"""Binary glTF of objects."""

import io

import numpy as np
import pytest

from openvima.catalog.packs import load_assets


def test_an_object_keeps_vertices_normals_and_texture() -> None:
    trimesh = pytest.importorskip("trimesh")
    from openvima.render.gltf import object_glb

    assets, size, scale = load_assets(), (0.05, 0.05, 0.05), (1.0, 1.0, 1.0)
    read = trimesh.load(io.BytesIO(object_glb(assets, "block", "red swirl", size, scale)), file_type="glb")
    (mesh,) = read.geometry.values()
    drawn = assets.geometry("block", size, scale).visual
    assert np.allclose(mesh.triangles, drawn.vertices)
    assert np.allclose(mesh.vertex_normals[mesh.faces], drawn.normals, atol=1e-6)
    assert np.array_equal(np.asarray(mesh.visual.material.baseColorTexture), assets.texture("red swirl"))
