"""Scenes and prompts: what is drawn where, with which id and colour; the page of all; cameras and rays."""

import html
import io
import re

import numpy as np
import pytest

from openvima.catalog import OBJECTS, TEXTURES
from openvima.catalog.bodies import block
from openvima.catalog.packs import load_assets
from openvima.catalog.procedural import ProceduralAssets
from openvima.errors import AssetError, ConfigError, ShapeError
from openvima.render import (
    CAMERAS,
    CELL_M,
    FRONT,
    LABEL_SHAPE,
    TOP,
    VIEWS,
    Drawable,
    Rasteriser,
    cell_centres,
    channels_first,
    channels_last,
    empty_labels,
    label_raster,
    project,
    stamp,
    unproject,
)
from openvima.render.gallery import write_gallery
from openvima.render.raycast import Hit, first_hit, object_below
from openvima.scene import ObjectImage, Placement, Pose, Prompt, Scene, SceneImage
from openvima.tasks import sample_episode
from sim_cases import COLOURS, BoxAssets

BLOCK = (0.07, 0.07, 0.07)
PROCEDURAL = load_assets("procedural")


def boxed(object_id: int, x: float, y: float, yaw_rad: float = 0.0, texture: str = "red") -> Placement:
    return Placement(object_id, "block", texture, BLOCK, Pose.planar(x, y, yaw_rad, z=0.034))


TWO_BLOCKS = Scene((boxed(5, 0.43, -0.21, 0.7), boxed(6, 0.6, 0.3, 2.0, "blue")))


@pytest.fixture
def rasteriser() -> Rasteriser:
    return Rasteriser(BoxAssets())


def at(image: np.ndarray, view: str, point: tuple[float, float, float]) -> np.ndarray:
    column, row = np.rint(project(np.array(point), CAMERAS[view])).astype(int)
    return image[..., row, column]


@pytest.mark.parametrize("view", VIEWS)
def test_the_bare_table_shows_floor_and_sheet(rasteriser, view) -> None:
    image = rasteriser.scene(Scene(()))[view]
    assert image.rgb.shape == (3, 128, 256)
    assert image.segm.shape == (128, 256)
    assert set(np.unique(image.segm)) == {0, 1}
    assert set(np.unique(image.rgb[:, image.segm == 0])) == {239}
    assert set(np.unique(image.rgb[:, image.segm == 1])) == {47}


def test_faces_of_a_red_box_are_lit_by_their_direction(rasteriser) -> None:
    scene = Scene((boxed(5, 0.5, 0.1),))
    images = rasteriser.scene(scene)
    red = np.array(COLOURS["red"])
    top, towards_viewer = (0.5, 0.1, 0.069), (0.535, 0.1, 0.034)
    for view in VIEWS:
        np.testing.assert_array_equal(at(images[view].rgb, view, top), np.floor(0.93967 * red))
    np.testing.assert_array_equal(at(images["front"].rgb, "front", towards_viewer), np.floor(0.6 * red))


@pytest.mark.parametrize("factor", [2, 3])
def test_an_enlarged_image_contains_the_plain_one(rasteriser, factor) -> None:
    scene = TWO_BLOCKS
    plain, large = rasteriser.scene(scene), rasteriser.scene(scene, enlarge=factor)
    for view in VIEWS:
        assert large[view].rgb.shape == (3, 128 * factor, 256 * factor)
        np.testing.assert_array_equal(
            large[view].rgb[:, factor - 1 :: factor, ::factor], plain[view].rgb, strict=True
        )
        np.testing.assert_array_equal(large[view].segm[factor - 1 :: factor, ::factor], plain[view].segm)


def test_further_bodies_are_drawn_with_their_own_id_and_colour(rasteriser) -> None:
    mesh = block((0.1, 0.1, 0.02)).visual
    tool = Drawable(mesh, Pose.planar(0.5, 0.0, z=0.2), 3, (204, 100, 50))
    images = rasteriser.scene(Scene((boxed(5, 0.5, 0.0),)), extra=[tool], views=("top",))
    assert list(images) == ["top"]
    assert at(images["top"].segm, "top", (0.5, 0.0, 0.21)) == 3
    np.testing.assert_array_equal(
        at(images["top"].rgb, "top", (0.5, 0.0, 0.21)), np.floor(0.93967 * np.array([204, 100, 50]))
    )


def test_images_do_not_depend_on_what_was_drawn_before(rasteriser) -> None:
    scene = TWO_BLOCKS
    first = rasteriser.scene(scene, depth=True)
    rasteriser.scene(Scene((boxed(5, 0.5, 0.0),)), depth=True)
    rasteriser.scene(scene, enlarge=2)
    again = rasteriser.scene(scene, depth=True)
    for view in VIEWS:
        for a, b in ((first[view].rgb, again[view].rgb), (first[view].segm, again[view].segm)):
            np.testing.assert_array_equal(a, b)
        assert not np.shares_memory(first[view].rgb, again[view].rgb)
        np.testing.assert_array_equal(first[view].depth, again[view].depth)


def test_an_object_image_shows_the_object_alone_on_white(rasteriser) -> None:
    fill = ObjectImage(boxed(9, 0.3, 0.2, 1.0, "blue"))
    rendered = rasteriser.prompt(Prompt("Take {a}.", (("a", fill),)))
    image = rendered.images["a"]
    assert (rendered.text, image.kind, image.name) == ("Take {a}.", "object", "a")
    (record,) = image.objects
    assert (record.object_id, record.object, record.texture) == (0, "block", "blue")
    for view in VIEWS:
        assert set(np.unique(image.segm[view])) == {0, 255}
        assert (image.rgb[view][:, image.segm[view] == 255] == 255).all()
    # The block is centred at (0.5, 0, 0): 0.07 m are 17.6 pixels.
    rows, columns = np.nonzero(image.segm["top"] == 0)
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (120, 136, 55, 71)


def test_prompt_objects_are_turned_by_a_quarter(rasteriser) -> None:
    long_box = Placement(5, "block", "red", (0.2, 0.05, 0.02), Pose((0.0, 0.0, 0.0)))
    segm = rasteriser.prompt(Prompt("{a}", (("a", ObjectImage(long_box)),))).images["a"].segm["top"]
    rows, columns = np.nonzero(segm == 0)
    assert np.ptp(columns) > 3 * np.ptp(rows)


def test_magnification_enlarges_the_whole_object(rasteriser) -> None:
    small = Placement(5, "block", "red", (0.03, 0.03, 0.03), Pose((0.0, 0.0, 0.0)))
    sizes = [
        (rasteriser.prompt(Prompt("{a}", (("a", ObjectImage(small, factor)),))).images["a"].segm["top"] == 0)
        for factor in (1.0, 7.0)
    ]
    rows, columns = np.nonzero(sizes[1])
    assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == (53, 53)  # 0.21 m are 52.7 pixels
    assert sizes[0].sum() < 70


def test_a_scene_image_numbers_its_objects_from_2(rasteriser) -> None:
    scene = Scene((boxed(5, 0.4, -0.2), boxed(8, 0.6, 0.2, texture="blue")))
    prompt = Prompt(
        "Make it {s}, not {a}.",
        (("s", SceneImage.of(scene.placements)), ("a", ObjectImage(boxed(5, 0.4, 0.0)))),
    )
    rendered = rasteriser.prompt(prompt)
    image = rendered.images["s"]
    assert list(rendered.images) == ["s", "a"]
    assert image.kind == "scene"
    assert [(r.object_id, r.texture) for r in image.objects] == [(2, "red"), (3, "blue")]
    for view in VIEWS:
        assert set(np.unique(image.segm[view])) == {0, 1, 2, 3}
        np.testing.assert_array_equal(image.rgb[view], rasteriser.scene(scene)[view].rgb)


def test_unfit_ids_textures_and_factors_are_refused(rasteriser) -> None:
    mesh, pose = block(BLOCK).visual, Pose((0.5, 0.0, 0.0))
    with pytest.raises(ShapeError, match="255"):
        rasteriser.scene(Scene(()), extra=[Drawable(mesh, pose, 255, (1, 2, 3))])
    with pytest.raises(ShapeError, match=r"uint8 \(H, W, 3\)"):
        rasteriser.scene(Scene(()), extra=[Drawable(mesh, pose, 3, np.zeros((4, 4)))])
    with pytest.raises(ConfigError):
        rasteriser.scene(Scene(()), enlarge=0)


ASSETS = BoxAssets()


def boxed_of_labels(object_id: int, pose: Pose) -> Placement:
    return Placement(object_id, "block", "red", (0.1, 0.05, 0.02), pose)


def test_cells_whose_centre_lies_on_the_object_carry_its_id() -> None:
    pose = Pose.planar(0.4, 0.2, 0.5, z=0.009)
    labels = label_raster(Scene((boxed_of_labels(7, pose),)), ASSETS)
    assert labels.shape == LABEL_SHAPE == (320, 160)
    assert labels.dtype == np.int16
    rows, columns = np.indices(LABEL_SHAPE)
    centres = cell_centres(rows, columns)
    local = pose.inverse().transform(np.dstack([centres, np.full(LABEL_SHAPE, 0.009)]))
    inside = (np.abs(local[..., 0]) <= 0.05) & (np.abs(local[..., 1]) <= 0.025)
    np.testing.assert_array_equal(labels == 7, inside)
    assert abs(inside.sum() * CELL_M**2 - 0.1 * 0.05) < 1e-4
    np.testing.assert_allclose(centres[0, 0], (0.25 + CELL_M / 2, -0.5 + CELL_M / 2))
    np.testing.assert_allclose(centres[-1, -1], (0.75 - CELL_M / 2, 0.5 - CELL_M / 2))


def test_stamping_one_by_one_gives_the_raster_of_all() -> None:
    rng = np.random.default_rng(3)
    drawn = rng.uniform((0.25, -0.5, 0.0), (0.75, 0.5, 6.0), (6, 3))
    placements = [boxed_of_labels(5 + i, Pose.planar(*xy_yaw, z=0.01 * i)) for i, xy_yaw in enumerate(drawn)]
    labels, heights = empty_labels()
    for placement in placements:
        stamp(labels, heights, placement, ASSETS)
    np.testing.assert_array_equal(labels, label_raster(placements, ASSETS))
    np.testing.assert_array_equal(heights > 0, labels > 0)


def test_an_object_keeps_vertices_normals_and_texture() -> None:
    trimesh = pytest.importorskip("trimesh")
    from openvima.render.gltf import object_glb

    assets, size, scale = PROCEDURAL, (0.05, 0.05, 0.05), (1.0, 1.0, 1.0)
    read = trimesh.load(io.BytesIO(object_glb(assets, "block", "red swirl", size, scale)), file_type="glb")
    (mesh,) = read.geometry.values()
    drawn = assets.geometry("block", size, scale).visual
    assert np.allclose(mesh.triangles, drawn.vertices)
    assert np.allclose(mesh.vertex_normals[mesh.faces], drawn.normals, atol=1e-6)
    assert np.array_equal(np.asarray(mesh.visual.material.baseColorTexture), assets.texture("red swirl"))


def cards(page) -> dict[str, str]:
    text = html.unescape(page.read_text(encoding="utf-8"))
    return dict(re.findall(r'<article class="card"><h3>([^<]+)</h3>(.*?)</article>', text, flags=re.DOTALL))


class _Incomplete(ProceduralAssets):
    """A pack without tiles and hearts."""

    def texture(self, texture_name: str):
        if texture_name == "tiles":
            raise AssetError(f"{texture_name} is missing")
        return super().texture(texture_name)

    def geometry(self, object_name, size, scale=(1.0, 1.0, 1.0)):
        if object_name == "heart":
            raise AssetError("kitting/heart.obj is missing")
        return super().geometry(object_name, size, scale)


@pytest.mark.slow
def test_the_page_has_a_card_for_every_object_and_texture_and_says_what_a_pack_lacks(tmp_path) -> None:
    page, problems = write_gallery(tmp_path, _Incomplete())
    assert set(problems) == {"kitting/heart.obj is missing", "tiles is missing"}
    assert page == tmp_path / "index.html"
    found = cards(page)
    assert list(found) == [*OBJECTS, *TEXTURES, "gray"]
    lacking = {name for name, card in found.items() if card.count("data:image/png") != 2}
    assert lacking == {"heart", "tiles"} and "heart is missing" in found["heart"]
    assert "9.0 × 10.3 × 3.3 cm" in found["letter A"]


# Point; X and Y (upwards) in the top view; the same in the front view. From the benchmark's own matrices.
KNOWN_POINTS = [
    ((0.5, 0.0, 0.0), (128.0, 64.0), (128.0, 48.0001)),
    ((0.25, -0.5, 0.0), (2.51, 126.745), (2.3024, 92.4429)),
    ((0.75, 0.5, 0.0), (253.49, 1.255), (253.7290, 3.5462)),
    ((0.5, 0.0, 0.1), (128.0, 64.0), (128.0, 65.7788)),
    ((0.41, 0.0, 0.0), (128.0, 86.5882), (128.0, 64.0008)),
]


@pytest.mark.parametrize(("point", "top", "front"), KNOWN_POINTS)
def test_points_land_on_the_pixels_that_the_benchmark_shows_them_at(point, top, front) -> None:
    for camera, (x, y) in ((TOP, top), (FRONT, front)):
        np.testing.assert_allclose(project(np.array(point), camera), (x, 127 - y), atol=1e-4)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("factor", [1, 3])
def test_unproject_undoes_project(view, factor) -> None:
    camera = CAMERAS[view].enlarged(factor)
    rng = np.random.default_rng(1)
    points = rng.uniform((0.2, -0.6, -0.01), (0.8, 0.6, 0.35), (50, 3))
    found = unproject(project(points, camera), camera, z=points[:, 2])
    np.testing.assert_allclose(found, points[:, :2], atol=1e-9)


@pytest.mark.parametrize("leading", [(), (5,), (2, 5)])
def test_the_layouts_differ_in_the_place_of_the_channels_alone(leading) -> None:
    images = np.arange(np.prod(leading, dtype=int) * 24).reshape(*leading, 3, 2, 4)
    last = channels_last(images)
    assert last.shape == (*leading, 2, 4, 3)
    assert np.array_equal(last[..., 1, 3, 2], images[..., 2, 1, 3])
    assert np.array_equal(channels_first(last), images)
    assert np.shares_memory(last, images)


def test_rays_from_above_meet_the_topmost_object() -> None:
    scene = sample_episode("manipulate_old_neighbor", seed=1).problem.scene
    labels = label_raster(scene, PROCEDURAL)
    rng = np.random.default_rng(0)
    cells = [*rng.permutation(np.argwhere(labels > 0))[:20].tolist(), [160, 2]]
    for row, column in cells:
        around = labels[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
        if (around == labels[row, column]).all():  # not at an outline
            x, y = cell_centres(np.array(row), np.array(column)).tolist()
            assert object_below(scene.placements, (x, y), PROCEDURAL) == labels[row, column]


def test_a_ray_meets_the_table_beside_objects_and_nothing_above_the_horizon() -> None:
    scene = sample_episode("rotate", seed=0).problem.scene
    assert first_hit((), (0.0, 0.0, 1.0), (1.0, 0.5, -2.0), PROCEDURAL) == Hit(0, (0.5, 0.25, 0.0))
    assert first_hit(scene.placements, (0.5, 0.0, 1.0), (0.0, 0.0, 1.0), PROCEDURAL) is None
    assert first_hit(scene.placements, (0.5, 0.0, 1.0), (1.0, 0.0, 0.0), PROCEDURAL) is None


def test_a_slanted_ray_meets_the_near_side() -> None:
    block = next(p for p in sample_episode("rotate", seed=0).problem.scene.placements)
    x, y, z = block.pose.position
    hit = first_hit((block,), (x + 1.0, y, z + 1.0), (-1.0, 0.0, -1.0), PROCEDURAL)
    assert hit is not None and hit.object_id == block.id
    assert hit.point[2] > 0 and hit.point[0] - x == pytest.approx(hit.point[2] - z)
