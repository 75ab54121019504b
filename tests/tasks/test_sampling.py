"""Sampling of starts and its seeds."""

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

from openvima.catalog import Assets, object_spec, pool
from openvima.catalog.partitions import PUBLISHED_LEVELS, PUBLISHED_TASKS
from openvima.errors import ConfigError, SamplingError
from openvima.render.labels import label_raster
from openvima.scene import FIRST_OBJECT_ID, Episode, EveryStepCounts, Outcome, Placement, Pose, in_workspace
from openvima.tasks import (
    DOMAINS,
    TableSampler,
    advance,
    begin,
    list_tasks,
    make_rng,
    register_task,
    registry,
    sample_episode,
    task_spec,
)
from openvima.tasks.table import CELL_M, is_in_hollow
from strategies import seeds
from task_cases import assert_uniform

HEIGHTS_OF_THEIR_OWN = (  # at which the original benchmark spawns some objects
    "follow_motion",
    "pick_in_order_then_restore",
    "rearrange",
    "rearrange_then_restore",
)
EVERYWHERE = [(task, level) for task in list_tasks() for level in task_spec(task).levels]


def table_for(assets: Assets, *, seed: int = 0, compat: bool = False) -> TableSampler:
    rng = np.random.default_rng(seed)
    return TableSampler(rng, pool("visual_manipulation", "train"), assets=assets, compat=compat)


def standing_on_the_table(episode: Episode) -> list[Placement]:
    """All objects but the one that starts in a base."""
    scene = episode.problem.scene
    starts_in_base = episode.task == "pick_in_order_then_restore"
    return [p for p in scene.placements if p.fixed or not starts_in_base]


def test_seeds_domains_and_levels_share_no_scene() -> None:
    kinds = [("train", "train"), ("train", "eval"), ("train", "user"), ("L1", "user")]
    scenes = [
        sample_episode("visual_manipulation", level=level, seed=seed, domain=domain).problem.scene
        for level, domain in kinds
        for seed in range(20)
    ]
    assert len(set(scenes)) == len(scenes)


@settings(max_examples=60)
@given(seeds)
def test_every_start_is_reproducible_open_inside_the_workspace_and_numbered_without_gaps(seed: int) -> None:
    task, level = EVERYWHERE[seed % len(EVERYWHERE)]
    episode = sample_episode(task, level=level, seed=seed)
    assert sample_episode(task, level=level, seed=seed) == episode
    problem, scene = episode.problem, episode.problem.scene
    first = FIRST_OBJECT_ID[scene.end_effector]
    assert [p.id for p in scene.placements] == list(range(first, first + len(scene.placements)))
    assert all(in_workspace(p.pose) for p in scene.placements)
    waiting = replace(problem, constraints=tuple(c for c in problem.constraints if c != EveryStepCounts()))
    assert advance(waiting, begin(problem), scene) == (begin(problem), Outcome())
    assert (episode.task, episode.level, episode.seed, episode.domain) == (task, level, seed, "user")
    assert episode.max_steps == episode.oracle_max_steps + 2


@pytest.mark.parametrize(("task", "level"), EVERYWHERE)
def test_objects_start_at_rest_or_hover_with_compat(task: str, level: str, assets: Assets) -> None:
    for placement in standing_on_the_table(sample_episode(task, level=level, seed=1)):
        rest_z_m = assets.geometry(placement.object, placement.size, placement.scale).rest_z_m
        assert placement.pose.z == rest_z_m
    if task in HEIGHTS_OF_THEIR_OWN:
        return
    for placement in sample_episode(task, level=level, seed=1, compat=True).problem.scene.placements:
        assert placement.pose.z == placement.size[2] * placement.scale[2] / 2


@pytest.mark.parametrize("task", list_tasks())
def test_no_two_objects_cover_the_same_cell(task: str, assets: Assets) -> None:
    for seed in range(3):
        episode = sample_episode(task, seed=seed)
        flat = {"line", "three-sided rectangle"}  # these two lie in one another
        apart = [p for p in standing_on_the_table(episode) if p.object not in flat]
        alone = sum((label_raster([p], assets) > 0).astype(int) for p in apart)
        assert np.max(alone) <= 1, seed


@pytest.mark.parametrize("task", PUBLISHED_TASKS)
def test_hardly_any_draw_is_thrown_away(task: str) -> None:
    level = task_spec(task).levels[-2 if "L5" in task_spec(task).levels else -1]
    assert sum(sample_episode(task, level=level, seed=seed).num_redraws for seed in range(20)) <= 1


def test_a_free_place_keeps_half_a_window_from_edge_and_objects(assets: Assets) -> None:
    table = table_for(assets)
    table.add("block", "red", size=(0.07, 0.07, 0.07), pose=Pose.planar(0.5, 0.0))
    size = object_spec("letter A").size_max
    half = round(float(np.hypot(size[0], size[1])) / CELL_M) / 2 * CELL_M
    for _ in range(200):
        pose = table.free_pose("letter A", size)
        assert pose is not None
        assert 0.25 + half <= pose.x <= 0.75 - half and -0.5 + half <= pose.y <= 0.5 - half
        assert max(abs(pose.x - 0.5), abs(pose.y)) >= 0.035 + half - 2 * CELL_M


def test_places_and_headings_are_uniform_over_what_is_free(assets: Assets) -> None:
    table = table_for(assets)
    poses = [table.free_pose("block", (0.07, 0.07, 0.07)) for _ in range(1000)]
    xs, ys, yaws = np.array([(p.x, p.y, p.yaw_rad) for p in poses if p is not None]).T
    for values, low, high in ((xs, 0.303, 0.697), (ys, -0.447, 0.447), (yaws, -np.pi, np.pi)):
        assert_uniform(np.floor((values - low) / (high - low) * 10).tolist(), range(10))


def test_a_crowded_table_has_no_free_place(assets: Assets) -> None:
    table = table_for(assets)
    for y in np.linspace(-0.4, 0.4, 7):
        table.add("pallet", "red", size=(0.21, 0.175, 0.035), pose=Pose.planar(0.5, float(y)))
    assert table.free_pose("letter A", object_spec("letter A").size_max) is None
    with pytest.raises(SamplingError, match="only 0 of 1 × target found a place in 10 tries"):
        table.place_one("target", lambda: ("letter A", "red"))


def test_the_bars_of_a_square_stay_on_the_table_and_off_other_objects(assets: Assets) -> None:
    # Its nominal size is one bar of 0.2 × 0.04 m; what is seen is 0.24 × 0.24 m.
    size = object_spec("square").size_max
    for seed in range(40):
        table = table_for(assets, seed=seed)
        letter = table.place_one("target", lambda: ("letter T", "red"))
        pose = table.free_pose("square", size)
        if pose is None:
            continue
        square = Placement(9, "square", "blue", size, pose.moved(dz=0.001), fixed=True)
        corners = pose.transform(np.array([[x, y, 0] for x in (-0.12, 0.12) for y in (-0.1, 0.1)]))
        assert (corners[:, 0] > 0.249).all() and (np.abs(corners[:, 1]) < 0.501).all()
        both = (label_raster([letter], assets) > 0) & (label_raster([square], assets) > 0)
        assert not both.any()


@pytest.mark.parametrize(
    ("size", "base", "reach"),
    [
        ((0.144, 0.144, 0.036), "frame", 0.1945),
        ((0.144, 0.144, 0.036), "square", 0.182),
        ((0.07, 0.07, 0.07), "frame", 0.1575),
        ((0.07, 0.07, 0.07), "container", -1.0),
    ],
)
def test_hollow_bases_keep_objects_out_of_their_middle(
    size: tuple[float, float, float], base: str, reach: float
) -> None:
    hollow = Placement(5, base, "red", object_spec(base).size_max, Pose.planar(0.5, 0.0), fixed=True)

    for distance in (0.0, reach - 1e-9, reach + 1e-6):
        placement = Placement(6, "any", "red", size, Pose.planar(0.5, distance))
        assert is_in_hollow(placement, hollow) is (abs(distance) < reach)


@pytest.mark.parametrize(
    ("first", "second", "reach"), [("frame", "block", 0.1575), ("block", "square", 0.145)]
)
def test_nothing_movable_stands_in_the_hollow_of_a_base(
    first: str, second: str, reach: float, assets: Assets
) -> None:
    for seed in range(60):
        table = table_for(assets, seed=seed, compat=True)
        table.add(first, "red", size=object_spec(first).size_max, pose=Pose.planar(0.5, 0.0))
        other = table.place_one("other", lambda: (second, "blue"), tries=50)
        assert other.pose.planar_distance(Pose.planar(0.5, 0.0)) > reach


def test_objects_keep_the_distance_asked_for_except_with_compat(assets: Assets) -> None:
    nearest = {}
    for compat in (False, True):
        distances = []
        for seed in range(40):
            table = table_for(assets, seed=seed, compat=compat)
            table.add("block", "blue", size=(0.07, 0.07, 0.07), pose=Pose.planar(0.5, 0.0))
            other = table.place_one("distractor", lambda: ("block", "red"), tries=100, apart_m=0.3)
            distances.append(other.pose.planar_distance(Pose.planar(0.5, 0.0)))
        nearest[compat] = min(distances)
    assert nearest[False] >= 0.3 > nearest[True]


def test_sizes_are_drawn_axis_by_axis(assets: Assets) -> None:
    table = table_for(assets)
    sizes = np.array([table.sample_size("container") for _ in range(200)])
    assert (sizes.min(axis=0) >= (0.15, 0.15, 0.05)).all() and (sizes.max(axis=0) <= (0.17, 0.17, 0.05)).all()
    assert abs(np.corrcoef(sizes[:, 0], sizes[:, 1])[0, 1]) < 0.25


Sample = Callable[[TableSampler], object]


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch) -> Callable[[Sample], None]:
    """Register a task "own" for the length of a test."""
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    pools = task_spec("rotate").pools
    return register_task("own", family="x", template="x.", oracle_max_steps=1, pools=pools)


@pytest.mark.parametrize("num_failures", [3, 1000])
def test_an_unlucky_draw_is_repeated_with_other_numbers_a_hundred_times(
    num_failures: int, register: Callable[[Sample], None]
) -> None:
    calls: list[int] = []

    def sample(table: TableSampler) -> object:
        calls.append(int(table.rng.integers(2**60)))
        if len(calls) <= num_failures:
            raise SamplingError("no luck.")
        return task_spec("rotate").sample(table)

    register(sample)
    if num_failures == 3:
        assert sample_episode("own", seed=0).num_redraws == 3
        assert len(set(calls)) == 4
    else:
        with pytest.raises(SamplingError, match="101 draws of own at level train, seed 5, failed: no luck"):
            sample_episode("own", seed=5)


@pytest.mark.parametrize(
    ("sample", "message"),
    [
        (lambda table: 1 // 0, r"`sample` of task 'own', seed 4, raised ZeroDivisionError: .*line \d+"),
        (lambda table: None, "`sample` of task 'own' returned a NoneType; return a Problem"),
        (
            lambda table: replace(task_spec("rotate").sample(table), oracle_max_steps=19),
            r"oracle_max_steps of task 'own' is 19; .* from 1 to 18",
        ),
    ],
)
def test_errors_in_a_task_name_it(sample: Sample, message: str, register: Callable[[Sample], None]) -> None:
    register(sample)
    with pytest.raises(ConfigError, match=message):
        sample_episode("own", seed=4)


def test_wrong_arguments_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'num_distractors'"):
        sample_episode("rotate", seed=0, num_distractor=2)
    with pytest.raises(ConfigError, match="Did you mean 'train'"):
        sample_episode("rotate", seed=0, domain="trian")
    for seed in (-1, 2**63, 1.5, "7", None, True):
        with pytest.raises(ConfigError, match=r"seed is .*give an integer from 0"):
            sample_episode("rotate", seed=seed)


def test_no_two_keys_share_a_stream() -> None:
    def first_draw(*key: object, attempt: int = 0) -> int:
        return int(make_rng(*key, attempt=attempt).integers(2**63))  # type: ignore[arg-type]

    keys = itertools.product(DOMAINS, ("rotate", "twist"), ("train", "L1"), range(50), ("scene", "oracle"))
    draws = [first_draw(*key) for key in keys]
    draws += [first_draw("user", "rotate", "train", 0, "scene", attempt=attempt) for attempt in range(1, 50)]
    draws.append(first_draw("user", "rotate", "train", 2**32, "scene"))  # wraps onto no small seed
    assert len(set(draws)) == len(draws)


@pytest.mark.slow
@pytest.mark.parametrize("task", PUBLISHED_TASKS)
def test_every_level_draws_all_shapes_of_its_pool_and_nothing_else(task: str) -> None:
    for level in sorted({*task_spec(task).levels} & {*PUBLISHED_LEVELS}):
        drawn_from = pool(task, level)
        scenes = (sample_episode(task, level=level, seed=seed).problem.scene for seed in range(150))
        drawn = [placement for scene in scenes for placement in scene.placements]
        shapes = {*drawn_from.dragged_objects, *drawn_from.base_objects}
        assert {p.object for p in drawn} - {"line"} == shapes - {"line"}
        if not task.startswith("rearrange"):  # whose distractors have any of the 49 textures
            textures = {*drawn_from.dragged_textures, *drawn_from.base_textures}
            assert {p.texture for p in drawn} <= textures
