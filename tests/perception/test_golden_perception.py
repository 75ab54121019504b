"""Perception against what the published evaluation script cuts out of the same frames."""

import os
from pathlib import Path

import numpy as np
import pytest

from openvima.perception.objects import ObjectViews, extract_objects

GOLDEN = Path(os.environ.get("OPENVIMA_GOLDEN", "../shared/golden")) / "model" / "preprocess.npz"
pytestmark = pytest.mark.skipif(not GOLDEN.is_file(), reason=f"no golden data at {GOLDEN}")


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(GOLDEN) as arrays:
        return dict(arrays)


def seen(golden: dict[str, np.ndarray], prefix: str, ids: np.ndarray) -> ObjectViews:
    rgb = {view: golden[f"{prefix}.rgb.{view}"] for view in ("front", "top")}
    segm = {view: golden[f"{prefix}.segm.{view}"] for view in ("front", "top")}
    return extract_objects(rgb, segm, ids)


@pytest.mark.parametrize(("view", "name"), [(0, "front"), (1, "top")])
def test_objects_of_an_observation_equal_the_golden_ones(golden, view, name):
    objects = seen(golden, "in.obs", golden["in.obs.object_ids"]).compact()
    np.testing.assert_array_equal(objects.masks[view], golden[f"out.obs.mask.{name}"][0, 0])
    np.testing.assert_array_equal(objects.boxes[view], golden[f"out.obs.bbox.{name}"][0, 0])
    np.testing.assert_array_equal(objects.crops[view], golden[f"out.obs.cropped_img.{name}"][0, 0])


@pytest.mark.parametrize(("view", "name"), [(0, "front"), (1, "top")])
def test_objects_of_prompt_images_equal_the_golden_ones(golden, view, name):
    assets = [
        ("in.prompt.dragged_obj", np.atleast_1d(golden["in.prompt.dragged_obj.object_id"])),
        ("in.prompt.scene", golden["in.prompt.scene.object_ids"]),
    ]
    for entry, (prefix, ids) in enumerate(assets):
        objects = seen(golden, prefix, ids).compact()
        count = int(objects.masks[view].sum())
        expected = golden[f"out.prompt.mask.{name}"][entry]
        assert count == expected.sum()
        np.testing.assert_array_equal(
            objects.boxes[view, :count], golden[f"out.prompt.bbox.{name}"][entry, :count]
        )
        np.testing.assert_array_equal(
            objects.crops[view, :count], golden[f"out.prompt.cropped_img.{name}"][entry, :count]
        )
