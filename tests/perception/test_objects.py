"""Boxes, crops and grasp points against slow twins and what the published evaluation script cuts out."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from naive import crop_and_box, most_interior
from naive_inputs import compacted
from openvima.errors import PolicyError, ShapeError
from openvima.perception.objects import (
    FRONT,
    TOP,
    ObjectViews,
    crop_box,
    extract_objects,
    observe,
    observe_prompt_image,
    whole_frames,
)
from openvima.render.camera import CAMERAS, unproject
from openvima.scene import ObjectRecord, PromptImage
from task_cases import noise

VIEWS = ("front", "top")
ID = 9
GOLDEN = Path(os.environ.get("OPENVIMA_GOLDEN", "../shared/golden")) / "model" / "preprocess.npz"


def empty() -> dict[str, np.ndarray]:
    return {view: np.ones((128, 256), np.uint8) for view in VIEWS}


def seen_in_top(shown: np.ndarray, rgb: dict[str, np.ndarray] | None = None) -> ObjectViews:
    segm = empty()
    segm["top"][shown] = ID
    return extract_objects(rgb or noise(), segm, [ID])


def rectangle(rows: slice, columns: slice) -> np.ndarray:
    shown = np.zeros((128, 256), bool)
    shown[rows, columns] = True
    return shown


@st.composite
def blobs(draw: st.DrawFn) -> np.ndarray:
    """A few overlapping rectangles and holes, as an object that others hide in part."""
    shown = np.zeros((128, 256), bool)
    for _ in range(draw(st.integers(1, 4))):
        row, column = draw(st.integers(0, 47)), draw(st.integers(0, 71))
        height, width = draw(st.integers(1, 40)), draw(st.integers(2, 60))
        shown[row : row + height, column : column + width] = draw(st.booleans())
    return shown


@settings(max_examples=60, derandomize=True)
@given(blobs())
def test_crops_boxes_and_grasps_equal_those_of_the_slow_twin(shown: np.ndarray) -> None:
    rgb = noise()
    objects = seen_in_top(shown, rgb)
    if shown.sum() < 2:
        assert not objects.masks.any()
        return
    crop, box = crop_and_box(rgb["top"], shown)
    np.testing.assert_array_equal(objects.boxes[TOP, 0], box)
    np.testing.assert_array_equal(objects.grasps[TOP, 0], most_interior(shown))
    assert np.abs(objects.crops[TOP, 0] - crop).max() < 1.01  # the twin does not round


@pytest.mark.parametrize("size", [1, 2, 31, 32, 33, 65, 128])
def test_crops_of_every_size_equal_those_of_the_slow_twin(size: int) -> None:
    rgb = noise()
    crop, box = crop_box(rgb["top"], (5, 5 + size - 1, 0, size - 1))
    expected, expected_box = crop_and_box(rgb["top"], rectangle(slice(0, size), slice(5, 5 + size)))
    np.testing.assert_array_equal(box, expected_box)
    assert np.abs(crop - expected).max() < 1.01
    if size == 32:
        np.testing.assert_array_equal(crop, expected)


@pytest.mark.parametrize(("count", "visible"), [(0, False), (1, False), (2, True)])
def test_an_object_counts_from_two_pixels(count: int, visible: bool) -> None:
    objects = seen_in_top(rectangle(slice(5, 6), slice(7, 7 + count)))
    assert objects.masks[TOP, 0] == visible
    assert objects.visible()[0] == visible
    if not visible:
        assert not objects.crops.any()
        assert not objects.boxes.any()
        assert not objects.grasps.any()


def test_an_object_is_placed_by_the_top_view_and_if_hidden_there_by_the_front_view() -> None:
    segm = empty()
    segm["front"][60:70, 100:111] = ID
    objects = extract_objects(noise(), segm, [ID])
    assert objects.masks[:, 0].tolist() == [True, False]
    expected = unproject(np.array([105, 64]), CAMERAS["front"])
    np.testing.assert_array_equal(objects.positions()[0], expected)
    np.testing.assert_array_equal(
        objects.grasp_points()[0], unproject(objects.grasps[FRONT, 0], CAMERAS["front"])
    )
    segm["top"][20:30, 30:41] = ID
    expected = unproject(np.array([35, 24]), CAMERAS["top"])
    np.testing.assert_array_equal(extract_objects(noise(), segm, [ID]).positions()[0], expected)


def test_slots_are_the_same_object_in_both_views_until_compacted() -> None:
    segm = empty()
    segm["front"][10:20, 10:20] = 7
    segm["top"][10:20, 10:20] = 8
    objects = extract_objects(noise(), segm, [7, 8])
    assert objects.masks.tolist() == [[True, False], [False, True]]
    moved = compacted(objects)
    assert moved.masks.tolist() == [[True, False], [True, False]]
    np.testing.assert_array_equal(moved.boxes[TOP, 0], objects.boxes[TOP, 1])
    np.testing.assert_array_equal(moved.crops[TOP, 0], objects.crops[TOP, 1])


@pytest.mark.parametrize(("effector", "first"), [(0, 5), (1, 4)])
def test_objects_of_an_observation_start_after_the_arm(effector: int, first: int) -> None:
    segm = empty()
    for number in (0, 2, 3, 4, 5, 254, 255):
        segm["top"][number % 100 : number % 100 + 1, 10 + number // 2 : 20 + number // 2] = number
    ids = observe({"rgb": noise(), "segm": segm, "ee": effector}).ids
    assert sorted(ids) == [number for number in (4, 5, 254) if number >= first]


def test_the_order_of_objects_is_that_of_the_image_and_not_of_the_ids() -> None:
    def ordered(ids: tuple[int, int, int]) -> list[list[int]]:
        segm = empty()
        for number, column in zip(ids, (200, 20, 100), strict=True):
            segm["top"][50:60, column : column + 10] = number
        return observe({"rgb": noise(), "segm": segm, "ee": 0}).boxes[TOP, :, 0].tolist()

    assert ordered((5, 6, 7)) == ordered((7, 5, 6)) == [24, 104, 204]


def test_prompt_images_keep_the_order_of_their_records_and_drop_what_is_hidden() -> None:
    segm = empty()
    segm["front"][50:60, 20:30] = 3
    segm["top"][50:60, 100:110] = 2
    records = tuple(ObjectRecord(number, "flower", "red") for number in (3, 4, 2))
    image = PromptImage("scene", "scene", noise(), segm, records)
    assert observe_prompt_image(image).ids.tolist() == [3, 2]


def test_images_that_are_not_contiguous_give_the_same() -> None:
    shown = rectangle(slice(10, 40), slice(30, 90))
    rgb, segm = noise(), empty()
    segm["top"][shown] = ID
    turned = {view: np.moveaxis(np.moveaxis(image, 0, -1).copy(), -1, 0) for view, image in rgb.items()}
    plain, other = extract_objects(rgb, segm, [ID]), extract_objects(turned, segm, [ID])
    np.testing.assert_array_equal(plain.crops, other.crops)


def test_of_objects_in_one_place_the_smaller_comes_first_whatever_its_id() -> None:
    for small, large in ((5, 6), (6, 5)):
        segm = empty()
        segm["top"][40:61, 100:121] = large
        segm["top"][45:56, 105:116] = small
        assert observe({"rgb": noise(), "segm": segm, "ee": 0}).ids.tolist() == [small, large]


def test_whole_frames_are_halved_with_halves_rounded_up() -> None:
    rgb = noise()
    frames = whole_frames(rgb)
    assert frames.crops.shape == (2, 1, 3, 64, 128)
    assert frames.masks.tolist() == [[True], [True]]
    for v, view in enumerate(VIEWS):
        blocks = rgb[view].astype(int).reshape(3, 64, 2, 128, 2).sum(axis=(2, 4))
        np.testing.assert_array_equal(frames.crops[v, 0], (blocks + 2) // 4)


def test_images_of_another_shape_or_dtype_are_refused() -> None:
    rgb, segm = noise(), empty()
    with pytest.raises(ShapeError, match="rgb 'front'"):
        extract_objects({**rgb, "front": rgb["front"].astype(float)}, segm, [ID])
    with pytest.raises(ShapeError, match="rgb 'front'"):
        extract_objects({**rgb, "front": rgb["front"].transpose(1, 2, 0)}, segm, [ID])
    with pytest.raises(ShapeError, match="segm 'top'"):
        extract_objects(rgb, {**segm, "top": segm["top"][:-1]}, [ID])


def test_an_image_of_more_objects_than_any_scene_is_refused_before_it_is_cropped(monkeypatch) -> None:
    monkeypatch.setattr("openvima.perception.objects.crop_box", lambda *_: pytest.fail("cropped"))
    many = {view: np.arange(128 * 256, dtype=np.uint8).reshape(128, 256) for view in ("front", "top")}
    for look in (
        lambda: observe({"rgb": noise(), "segm": many, "ee": 0}),
        lambda: extract_objects(noise(), many, [7] * 65),
    ):
        with pytest.raises(PolicyError, match=r"objects; at most 64 are allowed"):
            look()


@pytest.mark.skipif(not GOLDEN.is_file(), reason=f"no golden data at {GOLDEN}")
@pytest.mark.parametrize(("view", "name"), [*enumerate(VIEWS)])
def test_objects_of_observations_and_prompt_images_equal_the_golden_ones(view: int, name: str) -> None:
    with np.load(GOLDEN) as arrays:
        golden = dict(arrays)
    images = (
        ("obs", "in.obs", golden["in.obs.object_ids"], (0, 0)),
        ("prompt", "in.prompt.dragged_obj", np.atleast_1d(golden["in.prompt.dragged_obj.object_id"]), (0,)),
        ("prompt", "in.prompt.scene", golden["in.prompt.scene.object_ids"], (1,)),
    )
    for kind, prefix, ids, place in images:
        rgb, segm = ({v: golden[f"{prefix}.{part}.{v}"] for v in VIEWS} for part in ("rgb", "segm"))
        objects = compacted(extract_objects(rgb, segm, ids))
        expected = golden[f"out.{kind}.mask.{name}"][place]
        count = int(objects.masks[view].sum())
        assert count == expected.sum()
        if kind == "obs":  # other prompt images are padded to the longest
            np.testing.assert_array_equal(objects.masks[view], expected)
        for part, found in (("bbox", objects.boxes), ("cropped_img", objects.crops)):
            recorded = golden[f"out.{kind}.{part}.{name}"][place]
            np.testing.assert_array_equal(found[view, :count], recorded[:count])
