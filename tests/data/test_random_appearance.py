"""Demonstrations with random appearance: another look, the same task."""

from pathlib import Path

import numpy as np
import pytest

from openvima.catalog.objects import object_spec
from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import OBJECT_SETS
from openvima.catalog.random_pack import RandomAppearanceAssets, has_visible_heading, is_random
from openvima.cli.main import main
from openvima.data import Dataset
from openvima.data.object_cache import ObjectCache, open_object_cache
from openvima.data.rerender import (
    RandomAppearance,
    with_random_appearance,
)
from openvima.scene import Placement, Problem, SceneImage
from openvima.tasks import sample_episode

ASSETS = RandomAppearanceAssets(load_assets("procedural"), 4096)
TASKS = ("novel_adj", "scene_understanding", "same_shape", "twist", "sweep_without_exceeding")


def problem_of(task: str, seed: int = 0, **options) -> Problem:
    return sample_episode(
        task, level="train", seed=seed, domain="user", assets=ASSETS.base, **options
    ).problem


def placements_of(problem: Problem) -> list[Placement]:
    shown = list(problem.scene.placements)
    for _, image in problem.prompt.images:
        shown += image.scene.placements if isinstance(image, SceneImage) else [image.placement]
    return shown


def looks_of(
    problem: Problem, variant: int = 0, seed: int = 0, *, in_words: bool = False
) -> RandomAppearance:
    rng = np.random.default_rng(seed)
    return RandomAppearance(
        placements_of(problem),
        problem.prompt.text,
        in_words=in_words,
        variant=variant,
        assets=ASSETS,
        rng=rng,
    )


def height_m(placement: Placement) -> float:
    mesh = ASSETS.geometry(placement.object, placement.size, placement.scale).visual
    return float(np.ptp(mesh.vertices[..., 2]))


@pytest.mark.parametrize("task", TASKS)
def test_what_looked_alike_does_so_and_what_differed_differs(task):
    problem = problem_of(task)
    looks, old = looks_of(problem), placements_of(problem)
    new = [looks.of(placement) for placement in old]
    for name in ("object", "texture"):
        before, after = ([getattr(placement, name) for placement in each] for each in (old, new))
        assert len(set(after)) == len(set(before)) == len(set(zip(before, after, strict=True)))
    assert new != old
    seen = (*OBJECT_SETS["D_train"], *OBJECT_SETS["D_shape"], *OBJECT_SETS["B_train"])
    for ours, theirs in zip(new, old, strict=True):  # only the training partition gets other shapes
        assert ours.object == theirs.object or (is_random(ours.object) and theirs.object in seen)
        assert not is_random(theirs.object)
    assert [(p.id, p.pose.x, p.pose.y, p.pose.quaternion) for p in new] == [
        (p.id, p.pose.x, p.pose.y, p.pose.quaternion) for p in old
    ]


def test_headings_stay_visible_and_heights_stay():
    problem = problem_of("rotate")
    for variant in range(5):
        looks = looks_of(problem, variant)
        for placement in problem.scene.placements:
            new = looks.of(placement)
            assert not has_visible_heading(placement.object) or has_visible_heading(new.object)
            assert height_m(new) == pytest.approx(height_m(placement))


def test_textures_that_the_prompt_names_stay():
    problem = problem_of("scene_understanding")
    looks = looks_of(problem)
    kept = {p.texture for p in placements_of(problem) if looks.of(p).texture == p.texture}
    assert kept == {p.texture for p in placements_of(problem) if f" {p.texture} " in problem.prompt.text}
    assert len(kept) == 2


def test_shapes_stay_where_the_prompt_describes_them_in_words():
    problem = problem_of("visual_manipulation", prompts="text")
    looks = looks_of(problem, in_words=True)
    named = [p for p in problem.scene.placements if f"{p.texture} {p.object}" in problem.prompt.text]
    assert len(named) == 2
    for p in named:
        assert (looks.of(p).object, looks.of(p).texture) == (p.object, p.texture)


def test_a_container_is_replaced_where_container_is_but_a_word():
    containers = [
        (looks_of(problem).of(p).object, p.object)
        for seed in range(8)
        for problem in [problem_of("pick_in_order_then_restore", seed)]
        for p in problem.scene.placements
    ]
    assert "container" in {old for _, old in containers}
    assert all(is_random(new) for new, _ in containers)


def test_gray_stays_and_shades_stay_pairs():
    problems = (problem_of("novel_adj", seed) for seed in range(20))
    problem = next(
        p for p in problems if any(x.texture.startswith("dark ") for x in p.scene.placements if not x.fixed)
    )
    looks = looks_of(problem)
    grays = [p for p in placements_of(problem) if p.texture == "gray"]
    assert grays
    assert all(looks.of(p).texture == "gray" and is_random(looks.of(p).object) for p in grays)
    textures = {looks.of(p).texture for p in problem.scene.placements if not p.fixed}
    (dark,) = (texture for texture in textures if texture.startswith("dark "))
    assert dark.removeprefix("dark ") in textures


def test_profiles_stay_where_the_prompt_asks_for_them():
    kinds = {"square": "random square container", "circle": "random round container"}
    seen = set()
    for seed in range(6):
        problem = problem_of("same_shape", seed)
        looks = looks_of(problem)
        for placement in problem.scene.placements:
            new, profile = looks.of(placement).object, object_spec(placement.object).profile
            if placement.object in OBJECT_SETS["B_train"]:
                assert new.rpartition(" ")[0] == kinds[profile]
                seen.add(profile)
            else:
                assert new == placement.object
    assert seen == set(kinds)


def test_a_demonstration_keeps_its_actions_and_shows_its_objects_anew(demos: Path):
    dataset = Dataset(demos)
    shard = dataset.shard(dataset.shard_names()[0])
    demo = shard[0]
    new, other = (with_random_appearance(demo, shard.info, variant) for variant in (0, 1))
    again = with_random_appearance(demo, shard.info, 0)
    assert new.content_hash() == again.content_hash()
    assert len({each.content_hash() for each in (demo, new, other)}) == 3
    assert (new.actions, new.pick_ids, new.prompt.text) == (demo.actions, demo.pick_ids, demo.prompt.text)
    assert new.prompt.images.keys() == demo.prompt.images.keys()
    assert set(np.unique(new.segm["top"])) == set(np.unique(demo.segm["top"]))


def test_each_appearance_has_a_folder_of_its_own(copy: Path):
    dataset = Dataset(copy, tasks=["rotate"])
    caches = [open_object_cache(dataset, appearance=number) for number in (None, 0, 1)]
    assert [cache.folder.name for cache in caches] == [
        "objects-v7",
        "objects-v7-rerendered-v1-0",
        "objects-v7-rerendered-v1-1",
    ]
    stored, *others = caches
    for plain, *rows in zip(stored, *others, strict=True):
        for episode in rows:
            np.testing.assert_array_equal(episode.actions, plain.actions)
            assert episode.prompt.text == plain.prompt.text
            assert plain.descriptions and not episode.descriptions
            np.testing.assert_array_equal(np.sort(episode.pick_ids), np.sort(plain.pick_ids))
        assert len({each.images.tobytes() for each in (plain, *rows)}) == 3
    assert len(ObjectCache(dataset, variant="rerendered-v1-1")) == len(dataset)


def test_the_verb_makes_what_training_would(copy: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["data", "preprocess", str(copy), "--rerendered", "0"]) == 0
    folder = copy / "object_cache" / "objects-v7-rerendered-v1-0"
    assert capsys.readouterr().out.strip() == str(folder)
    times = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.arrow")}
    open_object_cache(Dataset(copy), appearance=0)
    assert times == {path.name: path.stat().st_mtime_ns for path in folder.glob("*.arrow")}
    for wrong in (["--rerendered", "-1"], ["--rerendered", "0", "--boxes", "detector"]):
        assert main(["data", "preprocess", str(copy), *wrong]) == 2
        assert "it must be 0 or more, and without --boxes" in capsys.readouterr().err
