"""Demonstrations of users: what may be recorded, and that folders are like generated ones."""

import dataclasses
import random
from pathlib import Path

import pytest

from openvima import compose
from openvima.catalog import load_assets
from openvima.data import Dataset, VerifyConfig, record_demonstration, verify
from openvima.data.user_demonstrations import demonstrate
from openvima.env import EnvConfig
from openvima.errors import DatasetError
from openvima.render.raycast import first_hit
from openvima.scene import Action, Episode
from openvima.tasks import sample_episode
from small_data_sets import contents

ALL = VerifyConfig(replay=None)
BOWL = ("bowl", "green", (0.55, 0.25))


def scene(*objects: tuple, goals: tuple = (("in", "a", "b"),)) -> Episode:
    return compose(
        objects or [("block", "red", (0.45, -0.25)), BOWL], "Put the {a} into the {b}.", goals=goals
    )


def clicked(episode: Episode, rng: random.Random) -> list[Action]:
    """Click on the object of each goal, seen from the front, and near the middle of its base."""
    actions = []
    for goal in episode.problem.goals:
        target, base = (episode.problem.scene[i] for i in (goal.object_id, goal.relative_to))
        x, y, z = target.pose.position
        origin = x + rng.uniform(-0.01, 0.01) + 0.6, y + rng.uniform(-0.01, 0.01), z + 0.8
        placements = episode.problem.scene.placements
        hit = first_hit(placements, origin, (-0.6, 0.0, -0.8), load_assets("procedural"))
        assert hit is not None and hit.object_id == target.id
        place = (base.pose.x + rng.uniform(-0.01, 0.01), base.pose.y + rng.uniform(-0.01, 0.01))
        actions.append(Action.planar(hit.point[:2], place))
    return actions


def refusal(folder: Path, episode: Episode, actions: list[Action], **options: object) -> str:
    with pytest.raises(DatasetError) as caught:
        record_demonstration(folder, episode, actions, **options)
    return str(caught.value)


def test_sampled_and_composed_successes_make_one_data_set(tmp_path: Path) -> None:
    rng = random.Random(0)
    episode = sample_episode("visual_manipulation", seed=0)
    assert record_demonstration(tmp_path, episode, clicked(episode, rng)) == 1
    assert record_demonstration(tmp_path, scene(), clicked(scene(), rng)) == 2
    assert record_demonstration(tmp_path, scene(), clicked(scene(), rng)) == 3  # by other clicks
    dataset = Dataset(tmp_path)
    assert dataset.index.column("task").to_pylist() == ["composed", "composed", "visual_manipulation"]
    assert set(dataset.index.column("domain").to_pylist()) == {"user"}
    demo = dataset[0]
    assert (demo.pick_ids, demo.place_ids) == ((5,), (6,)) and demo.outcome.success
    found = verify(tmp_path, ALL)
    assert found.is_clean and found.num_replayed == 3 and not found.notes, (found.problems, found.notes)


def test_a_changed_pose_of_a_composed_demonstration_does_not_replay() -> None:
    from openvima.data.verification import find_difference
    from openvima.env import TabletopEnv

    demo = demonstrate(scene(), clicked(scene(), random.Random(0)))
    env = TabletopEnv("rotate")
    assert find_difference(env, demo) == ""
    other = dataclasses.replace(demo, actions=(Action.planar((0.45, -0.25), (0.3, 0.0)),))
    assert "poses, joint_paths" in find_difference(env, other)


def test_nothing_of_an_evaluation_is_recorded(tmp_path: Path) -> None:
    out = tmp_path / "mine"
    held_out = sample_episode("visual_manipulation", level="L3", seed=0)
    assert "L3, user seed 0) stays unseen" in refusal(out, held_out, [])
    relabelled = dataclasses.replace(held_out, level="train")
    assert "not what the task samples" in refusal(out, relabelled, [])
    evaluated = sample_episode("visual_manipulation", seed=0, domain="eval")
    assert "eval seed 0) stays unseen" in refusal(out, evaluated, [])
    assert "has no goals" in refusal(out, scene(goals=()), [])
    optional = sample_episode("rotate", seed=0, difficulty="hard")
    assert "not what the task samples" in refusal(out, optional, [])
    options = EnvConfig(task_options="rotate.difficulty=hard")
    assert "only successes" in refusal(out, optional, [], env_config=options)
    assert not out.exists()


def test_actions_that_solve_nothing_are_not_recorded(tmp_path: Path) -> None:
    solution = clicked(scene(), random.Random(0))
    assert "action 1 moves nothing" in refusal(tmp_path, scene(), [Action.planar((0.3, 0.4), (0.5, 0.0))])
    assert "is not one" in refusal(tmp_path, scene(), [Action.planar((0.45, -0.25), (0.4, 0.0))])
    assert "action 2 of 2 is one too many" in refusal(tmp_path, scene(), solution * 2)
    assert not any(tmp_path.glob("*.arrow"))


def test_the_same_demonstration_is_recorded_once_but_finished_where_it_was_killed(tmp_path: Path) -> None:
    solution = clicked(scene(), random.Random(0))
    record_demonstration(tmp_path, scene(), solution)
    before = contents(tmp_path)
    assert "already (composed, seed" in refusal(tmp_path, scene(), solution)
    assert contents(tmp_path) == before
    for name in ("dataset.json", "index.parquet"):
        (tmp_path / name).unlink()
    assert record_demonstration(tmp_path, scene(), solution) == 1
    assert contents(tmp_path) == before


def test_sweeps_name_the_block_and_its_zone() -> None:
    objects = [("small block", "red", (0.5, 0.1)), ("three-sided rectangle", "blue", (0.5, -0.2))]
    episode = compose(objects, "Sweep {a}.", goals=[("swept_into", "a", "b")], end_effector="spatula")
    demo = demonstrate(episode, [Action.planar((0.5, 0.106), (0.5, -0.2325))])
    assert demo.outcome.success and (demo.pick_ids, demo.place_ids) == ((4,), (5,))
