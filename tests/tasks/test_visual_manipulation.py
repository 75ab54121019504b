"""Scenes and prompts of `visual_manipulation` follow its specification."""

import collections

import pytest

from openvima.catalog import TEXTURE_SETS, pool
from openvima.errors import ConfigError
from openvima.scene import AtPose, DistractorsApart, Placement, Pose, Problem
from openvima.tasks import advance, begin, sample_episode, task_spec
from task_cases import assert_frequencies, assert_uniform

NUM_EPISODES = 1000


def roles(problem: Problem) -> tuple[Placement, Placement, list[Placement]]:
    """Target, base and distractors."""
    (goal,) = problem.goals
    (constraint,) = problem.constraints
    assert isinstance(goal, AtPose) and goal.relative_to is not None
    assert isinstance(constraint, DistractorsApart)
    return (
        problem.scene[goal.object_id],
        problem.scene[goal.relative_to],
        [problem.scene[i] for i in constraint.object_ids],
    )


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode("visual_manipulation", seed=seed).problem for seed in range(NUM_EPISODES)]


@pytest.mark.slow
def test_shapes_and_textures_are_uniform(problems: list[Problem]) -> None:
    pool = task_spec("visual_manipulation").pool("train")
    targets, bases = [roles(p)[0] for p in problems], [roles(p)[1] for p in problems]
    assert_uniform([t.texture for t in targets], pool.dragged_textures)
    assert_uniform([b.texture for b in bases], pool.base_textures)
    assert_uniform([b.object for b in bases], pool.base_objects)
    # Narrow shapes fit beside a hollow base more often, so targets are uniform only roughly.
    counts = collections.Counter(t.object for t in targets)
    assert set(counts) == set(pool.dragged_objects)
    assert all(0.6 < count * 14 / NUM_EPISODES < 1.5 for count in counts.values())


@pytest.mark.slow
def test_a_distractor_shares_shape_or_texture_but_never_both(problems: list[Problem]) -> None:
    shared = collections.Counter()
    for problem in problems:
        target, base, (distractor,) = roles(problem)
        for name, other in (("target", target), ("base", base)):
            same_shape, same_texture = distractor.object == other.object, distractor.texture == other.texture
            assert not (same_shape and same_texture)
            shared[name, "shape"] += same_shape
            shared[name, "texture"] += same_texture
    assert min(shared.values()) > 10 and len(shared) == 4


@pytest.mark.slow
def test_distractors_that_look_like_bases_are_fixed(problems: list[Problem]) -> None:
    pool = task_spec("visual_manipulation").pool("train")
    num_bases = 0
    for problem in problems:
        target, base, (distractor,) = roles(problem)
        assert base.fixed and not target.fixed
        assert distractor.fixed is (distractor.object in pool.base_objects)
        num_bases += distractor.fixed
    assert 0.15 < num_bases / NUM_EPISODES < 0.26  # 4 of 18 shapes, some of them harder to place


@pytest.mark.slow
def test_nothing_starts_within_the_tolerance_of_anything(problems: list[Problem]) -> None:
    for problem in problems:
        placements = problem.scene.placements
        assert all(
            a.pose.planar_distance(b.pose) >= 0.1 for a in placements for b in placements if a.id < b.id
        )


@pytest.mark.slow
def test_the_goal_is_the_place_of_the_base(problems: list[Problem]) -> None:
    (goal,) = problems[0].goals
    _, base, _ = roles(problems[0])
    assert isinstance(goal, AtPose)
    assert goal.target == base.pose and goal.tolerance.position_m == 0.1 and goal.tolerance.yaw_rad is None


@pytest.mark.parametrize(("difficulty", "dragged", "base"), [("easy", "C1", "C2"), ("hard", "C2", "C1")])
def test_hard_exchanges_the_textures(difficulty: str, dragged: str, base: str) -> None:
    for seed in range(40):
        problem = sample_episode("visual_manipulation", seed=seed, difficulty=difficulty).problem
        assert roles(problem)[0].texture in TEXTURE_SETS[dragged]
        assert roles(problem)[1].texture in TEXTURE_SETS[base]


def test_medium_draws_both_roles_from_one_of_the_sets() -> None:
    sets = []
    for seed in range(200):
        target, base, _ = roles(sample_episode("visual_manipulation", seed=seed, difficulty="medium").problem)
        sets.append(target.texture in TEXTURE_SETS["C1"])
        assert (base.texture in TEXTURE_SETS["C1"]) is sets[-1]
    assert_frequencies(sets, {True: 0.5, False: 0.5})


@pytest.mark.parametrize("num_distractors", [0, 2, 3])
def test_the_number_of_distractors_can_be_chosen(num_distractors: int) -> None:
    for seed in range(20):
        problem = sample_episode("visual_manipulation", seed=seed, num_distractors=num_distractors).problem
        assert len(roles(problem)[2]) == num_distractors
        assert len(problem.scene.placements) == 2 + num_distractors


@pytest.mark.parametrize("level", ["train", "L1", "L2", "L3"])
def test_every_level_draws_from_its_pool(level: str) -> None:
    drawn_from = pool("visual_manipulation", level)
    for seed in range(100):
        target, base, _ = roles(sample_episode("visual_manipulation", level=level, seed=seed).problem)
        assert target.object in drawn_from.dragged_objects and target.texture in drawn_from.dragged_textures
        assert base.object in drawn_from.base_objects and base.texture in drawn_from.base_textures


@pytest.mark.parametrize(
    ("target_at", "distractor_at", "success", "failure"),
    [
        (0.099, None, True, False),
        (0.101, None, False, False),
        (None, 0.099, False, True),
        (None, 0.101, False, False),
        (0.05, 0.14, False, True),  # in the base, but 0.09 m from the distractor
    ],
)
def test_distances_decide(
    target_at: float | None, distractor_at: float | None, success: bool, failure: bool
) -> None:
    problem = sample_episode("visual_manipulation", seed=1).problem
    target, base, (distractor,) = roles(problem)
    inward = 1.0 if base.pose.y < 0 else -1.0
    moved = {
        object_id: base.pose.moved(dy=inward * distance)
        for object_id, distance in ((target.id, target_at), (distractor.id, distractor_at))
        if distance is not None
    }
    outcome = advance(problem, begin(problem), problem.scene.with_poses(moved))[1]
    assert (outcome.success, outcome.failure) == (success, failure), outcome.reason


def test_a_lost_target_is_a_failure() -> None:
    problem = sample_episode("visual_manipulation", seed=1).problem
    lost = problem.scene.with_poses({roles(problem)[0].id: Pose.planar(0.76, 0.0)})
    assert advance(problem, begin(problem), lost)[1].failure


@pytest.mark.parametrize(
    "options", [{"num_distractors": 7}, {"num_distractors": -1}, {"difficulty": "Easy!"}]
)
def test_bad_options_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        sample_episode("visual_manipulation", seed=0, **options)


def test_with_compat_objects_hover_and_keep_the_order_of_placing() -> None:
    for seed in range(20):
        problem = sample_episode("visual_manipulation", seed=seed, compat=True).problem
        target, base, (distractor,) = roles(problem)
        assert (base.id, target.id, distractor.id) == (5, 6, 7)
        assert target.pose.z == pytest.approx(target.size[2] / 2)
