"""Published episodes become demonstrations, from archives and folders, of both generations."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from openvima.data import Demonstration
from openvima.data.published import Broken, EpisodeKey, PublishedData
from openvima.data.published_episode import infer_picks
from openvima.data.records import rollout_oracle
from openvima.data.schema import UNKNOWN_ID
from openvima.env import EnvConfig
from openvima.errors import DatasetError, UnknownTaskError
from openvima.scene import ObjectRecord
from published_data import PUBLISHED, TODAY, Generation, MadeEpisode, jpeg, pickled, write_folder, write_zip

Files = dict[str, bytes]
SCENE = MadeEpisode(
    seed=12,
    prompt="Rearrange to this {scene}.",
    num_steps=11,
    picks=[(0.3 + 0.02 * step, -0.3) for step in range(11)],
    images={"scene": ("scene", [(2, "bowl", "red swirl"), (3, "letter A", "wooden")])},
)


def episodes(generation: Generation = PUBLISHED) -> dict[str, Files]:
    old = generation is PUBLISHED
    return {
        f"{'simple_manipulation' if old else 'visual_manipulation'}/000004": MadeEpisode(3).files(generation),
        "rearrange/000000": SCENE.files(generation),
        "rearrange/090017": MadeEpisode(5).files(generation),
    }


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_zip(tmp_path_factory.mktemp("source") / "vima.zip", episodes())


def test_keys_are_sorted_and_have_todays_names(path: Path) -> None:
    keys = [("rearrange", "000000"), ("rearrange", "090017"), ("visual_manipulation", "000004")]
    data = PublishedData(path)
    assert data.keys == tuple(EpisodeKey(*key) for key in keys)
    assert len(data) == 3
    assert [demo.seed for demo in data] == [12, 5, 3]
    assert data[-1].task == "visual_manipulation"


def test_an_episode_comes_with_all_that_is_known(path: Path) -> None:
    demo = PublishedData(path).read("rearrange", "000000")
    frames, segm = SCENE.frames(), SCENE.segmentation()
    for view in ("front", "top"):
        assert demo.rgb[view].shape == (12, 3, 128, 256)
        error = np.abs(demo.rgb[view].astype(int) - frames[view].transpose(0, 3, 1, 2))
        assert error.mean() < 3  # JPEG; with frames out of order it would be above 10
        assert np.array_equal(demo.segm[view], segm[view])
    assert demo.end_effector == "suction"
    assert demo.actions[2].pose0_position == pytest.approx((0.34, -0.3), abs=1e-6)
    assert demo.actions[2].pose1_position == pytest.approx((0.44, -0.25), abs=1e-6)
    assert demo.actions[2].pose1_rotation == (0, 0, 1, 0)
    assert demo.objects == (ObjectRecord(5, "bowl", "red swirl"), ObjectRecord(6, "letter A", "wooden"))
    assert demo.pick_ids == (6,) * 11
    assert demo.place_ids == (UNKNOWN_ID,) * 11
    assert (demo.scenes, demo.joint_paths) == ((), ())
    assert (demo.seed, demo.domain, demo.level, demo.assets) == (12, "published", "train", "original")
    assert demo.outcome.success
    assert demo.outcome.reason == "rearrange/000000"
    assert demo.prompt.text == "Rearrange to this {scene}."
    image = demo.prompt.images["scene"]
    assert image.kind == "scene"
    assert image.objects == (ObjectRecord(2, "bowl", "red swirl"), ObjectRecord(3, "letter A", "wooden"))
    assert image.rgb["top"].shape == (3, 128, 256)
    assert np.unique(image.segm["front"]).tolist() == [0, 2]


def test_prompt_images_come_in_the_order_of_the_text(path: Path) -> None:
    demo = PublishedData(path).read("visual_manipulation", "000004")
    assert list(demo.prompt.images) == ["dragged_obj_1", "base_obj"]
    assert demo.prompt.images["base_obj"].objects == (ObjectRecord(0, "bowl", "red swirl"),)


def test_both_generations_and_both_forms_hold_the_same(path: Path, tmp_path: Path) -> None:
    write_folder(tmp_path / "old" / "vima_v6", episodes())
    write_folder(tmp_path / "new", episodes(TODAY))
    sources = [path, tmp_path / "old", tmp_path / "old" / "vima_v6", tmp_path / "new"]
    old, *others = (PublishedData(source) for source in sources)
    for other in others:
        assert other.keys == old.keys
        for a, b in zip(old, other, strict=True):
            reason = dataclasses.replace(a.outcome, reason=b.outcome.reason)
            assert dataclasses.replace(a, outcome=reason).content_hash() == b.content_hash()


def test_the_folder_of_one_task_is_enough(tmp_path: Path) -> None:
    write_folder(tmp_path, episodes())
    data = PublishedData(tmp_path / "simple_manipulation")
    assert data.keys == (("visual_manipulation", "000004"),)
    assert data[0].outcome.reason == "simple_manipulation/000004"


@pytest.mark.parametrize("name", ["simple_manipulation", "visual_manipulation"])
def test_old_and_new_names_select_a_task(path: Path, name: str) -> None:
    assert PublishedData(path, tasks=[name]).keys == (("visual_manipulation", "000004"),)
    assert PublishedData(path).read(name, "000004").seed == 3
    assert [demo.seed for demo in PublishedData(path, tasks=[name])] == [3]


def test_what_is_not_there_is_said(path: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"vima\.zip has no episodes of rotate; it has rearrange, vis"):
        PublishedData(path, tasks=["rotate"])
    with pytest.raises(UnknownTaskError, match="Did you mean 'rotate'"):
        PublishedData(path, tasks=["rotat"])
    with pytest.raises(DatasetError, match="no episode rearrange/000001"):
        PublishedData(path).read("rearrange", "000001")
    with pytest.raises(DatasetError, match="no file or folder"):
        PublishedData(tmp_path / "missing.zip")
    with pytest.raises(DatasetError, match="holds no episodes"):
        PublishedData(tmp_path)


def changed(**changes: object) -> Files:
    """An episode whose trajectory differs in some entries; ... takes one away."""
    fields = {**MadeEpisode().trajectory(PUBLISHED), **changes}
    kept = {key: value for key, value in fields.items() if value is not ...}
    return {**MadeEpisode().files(PUBLISHED), "trajectory.pkl": pickled(kept)}


def with_file(name: str, value: object) -> Files:
    files = dict(MadeEpisode().files(PUBLISHED))
    if value is None:
        del files[name]
    else:
        files[name] = value if isinstance(value, bytes) else pickled(value)
    return files


def with_actions(**changes: np.ndarray) -> Files:
    return with_file("action.pkl", {**MadeEpisode().actions(3), **changes})


WHOLE = MadeEpisode().files(PUBLISHED)
FRAME = MadeEpisode().frames()["top"][0]
JPEG = WHOLE["rgb_top/0.jpg"]
UNKNOWN_OBJECT = {5: ("bowl", "red swirl"), 6: ("teapot", "wooden")}
FAULTS: dict[str, tuple[Callable[[], Files], str]] = {
    "no obs": (lambda: with_file("obs.pkl", None), r"obs\.pkl is missing"),
    "empty pickle": (
        lambda: with_file("trajectory.pkl", b""),
        r"trajectory\.pkl: it is truncated or no pickle of data",
    ),
    "hostile pickle": (
        lambda: with_file("action.pkl", b"cos\nsystem\n(X\x04\x00\x00\x00truetR."),
        r"action\.pkl: it names os\.system.*nothing was run",
    ),
    "cut image": (
        lambda: with_file("rgb_top/1.jpg", JPEG[:700]),
        r"rgb_top/1\.jpg is no whole",
    ),
    "small image": (lambda: with_file("rgb_top/0.jpg", jpeg(FRAME[:64])), r"rgb_top/0\.jpg is \(256, 64\)"),
    "huge image": (
        lambda: with_file("rgb_top/0.jpg", JPEG.replace(b"\0\x80\1\0", b"\xff\xff\xff\xff")),
        r"rgb_top/0\.jpg is",
    ),
    "gray image": (
        lambda: with_file("rgb_top/0.jpg", jpeg(FRAME[..., 0])),
        r"rgb_top/0\.jpg is \(256, 128\), L",
    ),
    "missing image": (
        lambda: with_file("rgb_front/0.jpg", None),
        "rgb_front has 1 images for 1 actions",
    ),
    "shape of segm": (
        lambda: with_file("obs.pkl", {"ee": np.zeros(2), "segm": {"front": FRAME, "top": FRAME}}),
        r"obs\.pkl: it has images of shape \(128, 256, 3\)",
    ),
    "other tool": (lambda: changed(end_effector_type="spatula"), r"trajectory\.pkl: the tool is 'spatula'"),
    "no tool": (lambda: changed(end_effector_type="hand"), r"trajectory\.pkl is .*another form"),
    "not finite": (
        lambda: with_actions(pose0_position=np.array([[np.nan, 0, 0]], np.float32)),
        r"action\.pkl: pose0_position is \[\[nan",
    ),
    "off the table": (
        lambda: with_actions(pose1_position=np.array([[0.5, 0.6]], np.float32)),
        r"pose1_position is .* within \(0\.25, -0\.5\)",
    ),
    "actions of unequal number": (
        lambda: with_actions(pose1_rotation=np.ones((2, 4), np.float32)),
        r"action\.pkl is .*another form .*longer",
    ),
    "shape of actions": (
        lambda: with_actions(pose0_rotation=np.ones((1, 3))),
        r"it must be of shape \(T, 4\)",
    ),
    "text as actions": (lambda: with_file("action.pkl", {"pose0_position": "x"}), "'x' where an array"),
    "steps": (lambda: changed(steps=4), "steps is 4; 1 is needed"),
    "failed": (lambda: changed(success=False), "success is False; True"),
    "difficulty": (lambda: changed(difficulty="hard"), "difficulty is 'hard'"),
    "seed": (lambda: changed(seed=-1), "a number is -1; a whole one"),
    "seed as text": (lambda: changed(seed="x" * 500), r"a number is 'x{59};"),
    "prompt without image": (lambda: changed(prompt_assets={}), "names images"),
    "prompt": (lambda: changed(prompt=3), r"trajectory\.pkl is .*another form"),
    "unknown object": (
        lambda: MadeEpisode(objects=UNKNOWN_OBJECT).files(PUBLISHED),
        r"trajectory\.pkl: there is no object 'teapot'",
    ),
}


@pytest.fixture(scope="module")
def broken_source(tmp_path_factory: pytest.TempPathFactory) -> tuple[PublishedData, list[Broken]]:
    """One episode a fault, and one without."""
    folder = tmp_path_factory.mktemp("broken")
    made = {f"rotate/{number:06d}": make() for number, (make, _) in enumerate(FAULTS.values())}
    data = PublishedData(write_zip(folder / "vima.zip", {**made, "rotate/777777": WHOLE}))
    broken: list[Broken] = []
    whole = list(data.demonstrations(on_broken=broken.append))
    assert [demo.outcome.reason for demo in whole] == ["rotate/777777"]
    return data, broken


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_episode_is_named_and_skipped(
    broken_source: tuple[PublishedData, list[Broken]], fault: str
) -> None:
    data, broken = broken_source
    number, reason = list(FAULTS).index(fault), FAULTS[fault][1]
    assert broken[number].member == f"rotate/{number:06d}"
    with pytest.raises(DatasetError, match=r"vima\.zip: rotate/\d+: .*" + reason):
        data.read("rotate", f"{number:06d}")


def test_a_source_that_vanishes_is_no_pile_of_broken_episodes(tmp_path: Path) -> None:
    write_folder(tmp_path / "a", episodes())
    data = PublishedData(tmp_path / "a")
    shutil.rmtree(tmp_path / "a")
    with pytest.raises(DatasetError, match=r"a cannot be read: No such file"):
        list(data.demonstrations())


def test_unknown_textures_are_kept(tmp_path: Path) -> None:
    made = MadeEpisode(objects={5: ("bowl", "velvet"), 6: ("letter A", "wooden")})
    data = PublishedData(write_zip(tmp_path / "a.zip", {"rotate/000000": made.files(PUBLISHED)}))
    assert data[0].objects[0].texture == "velvet"


@pytest.mark.parametrize("task", ["visual_manipulation", "sweep_without_exceeding", "rearrange"])
def test_picks_are_found_again_in_the_images(task: str) -> None:
    demo: Demonstration = rollout_oracle(EnvConfig(compat=True).make(task, "train", domain="user"), 0)
    ids = [record.object_id for record in demo.objects]
    assert infer_picks(demo.segm["top"], demo.actions, ids) == demo.pick_ids
    nothing = np.zeros_like(demo.segm["top"])
    assert infer_picks(nothing, demo.actions, ids) == (UNKNOWN_ID,) * demo.num_steps
