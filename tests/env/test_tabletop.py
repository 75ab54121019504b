"""The environment: what it accepts, what it refuses, and how episodes end."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import openvima
from openvima.env import TabletopEnv
from openvima.env.registration import environment_id
from openvima.errors import (
    ActionError,
    ConfigError,
    EpisodeError,
    SamplingError,
)
from openvima.render import channels_first
from openvima.scene import Action, Outcome
from openvima.tasks import list_tasks, sample_episode, task_spec
from task_cases import REPRESENTATIVE_TASKS, frozen


def idle_action() -> dict[str, np.ndarray]:
    """An action that picks in an empty corner and therefore moves nothing."""
    return Action.planar((0.25, -0.5), (0.25, -0.5)).to_arrays()


@pytest.fixture(scope="module")
def rotate() -> TabletopEnv:
    return TabletopEnv("rotate")


LOW_LEVEL = {"control": "end_effector", "modalities": ("rgb", "segm", "joints")}


@pytest.mark.parametrize(
    ("task", "options"), [("sweep_without_touching", {}), ("put_then_restore", {}), ("rotate", LOW_LEVEL)]
)
def test_gymnasium_finds_nothing_to_complain_about(task: str, options: dict) -> None:
    env = gymnasium.make(f"openvima/{task}-v1", level=task_spec(task).levels[-1], **options).unwrapped
    with warnings.catch_warnings():
        # Positions are in metres, as published actions are, and so lie in 0.25 … 0.75 rather than -1 … 1.
        warnings.filterwarnings("ignore", message=".*we recommend using a symmetric and normalized space")
        check_env(env)


@pytest.mark.parametrize("task", ["rotate", "sweep_without_touching"])
def test_doing_nothing_useful_is_cut_off_after_the_last_step(task: str) -> None:
    env = TabletopEnv(task)
    env.reset(seed=1)
    ends = []
    for _ in range(env.episode.max_steps):
        _, reward, terminated, truncated, info = env.step(idle_action())
        ends.append((reward, terminated, truncated, info["success"], info["failure"]))
    assert ends[:-1] == [(0.0, False, False, False, False)] * (env.episode.max_steps - 1)
    assert ends[-1] == (0.0, False, True, False, False)
    assert env.episode.max_steps == env.episode.oracle_max_steps + 2


def test_doing_nothing_useful_fails_where_every_step_counts() -> None:
    env = TabletopEnv("follow_order")
    env.reset(seed=1)
    _, reward, terminated, truncated, info = env.step(idle_action())
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info["failure"]
    assert info["reason"]


@pytest.mark.parametrize("task", REPRESENTATIVE_TASKS[::3])
def test_an_environment_that_was_used_gives_the_same_bytes_as_a_fresh_one(task: str) -> None:
    def play(env: TabletopEnv) -> object:
        result = [env.reset(seed=3)]
        result.append(env.step(env.oracle_decision().action))
        return frozen([result, env.prompt, env.joint_path])

    used = TabletopEnv(task)
    used.reset(seed=8)
    used.render()
    used.step(idle_action())
    assert play(used) == play(TabletopEnv(task))


def test_it_can_be_made_by_name_in_two_ways() -> None:
    wrapped = gymnasium.make("openvima/rotate-v1", level="L1")
    bare = openvima.make("rotate", level="L1")
    assert isinstance(wrapped.unwrapped, TabletopEnv)
    assert frozen(wrapped.reset(seed=2)) == frozen(bare.reset(seed=2))


def test_names_are_checked_when_it_is_made() -> None:
    with pytest.raises(ConfigError, match="rgb_array"):
        TabletopEnv("rotate", render_mode="human")
    with pytest.raises(ConfigError, match=r"seed domain 'evil'. Did you mean 'eval'"):
        TabletopEnv("rotate", domain="evil")


def test_a_step_before_the_first_reset_is_refused() -> None:
    env = TabletopEnv("rotate")
    with pytest.raises(EpisodeError, match="reset"):
        env.step(idle_action())
    with pytest.raises(EpisodeError, match="reset"):
        _ = env.prompt


def test_a_step_after_the_end_is_refused(rotate: TabletopEnv) -> None:
    rotate.reset(seed=0)
    while not rotate.outcome.is_over:
        rotate.step(rotate.oracle_decision().action)
    with pytest.raises(EpisodeError, match=r"ended at step \d+; reset"):
        rotate.step(idle_action())


def test_a_step_in_two_parts_is_the_same_and_renders_in_the_second_alone(
    rotate: TabletopEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    rotate.reset(seed=0)
    action = rotate.oracle_decision().action
    observation, *whole = rotate.step(action)
    rotate.reset(seed=0)
    with monkeypatch.context() as patch:
        patch.setattr(rotate, "observe", None)
        parts = rotate.advance(action)
    assert frozen(parts) == frozen(whole)
    assert frozen(rotate.observe()) == frozen(observation)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (idle_action() | {"pose0_position": np.float32([0.8, 0.1])}, "pose0_position is .0.8"),
        ({}, "missing"),
        (np.zeros(12, np.float32), "a mapping with keys .* not ndarray"),
    ],
)
def test_an_action_that_does_not_fit_changes_nothing(action: object, message: str) -> None:
    untouched, env = TabletopEnv("rotate"), TabletopEnv("rotate")
    untouched.reset(seed=4)
    env.reset(seed=4)
    before = env.scene
    with pytest.raises(ActionError, match=message):
        env.step(action)
    assert env.scene == before
    expected = untouched.step(untouched.oracle_decision().action)
    assert frozen(env.step(env.oracle_decision().action)) == frozen(expected)


def test_a_zero_quaternion_is_no_turn_and_a_long_one_is_normalised(rotate: TabletopEnv) -> None:
    rotate.reset(seed=4)
    action = rotate.oracle_decision().action.to_arrays()
    results = []
    for turn in ([0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0.5]):
        rotate.reset(seed=4)
        results.append(frozen(rotate.step({**action, "pose0_rotation": np.float32(turn)})))
    assert results[0] == results[1] == results[2]


def test_resets_without_a_seed_give_a_series_that_the_last_seed_decides(rotate: TabletopEnv) -> None:
    rotate.reset(seed=1)
    series = [rotate.reset()[1]["seed"] for _ in range(3)]
    rotate.reset(seed=1)
    assert [rotate.reset()[1]["seed"] for _ in range(3)] == series
    assert len(set(series)) == 3


def test_a_given_episode_is_loaded(rotate: TabletopEnv) -> None:
    episode = sample_episode("rotate", level="L2", seed=11, domain="eval")
    observation, info = rotate.reset(options={"episode": episode})
    expected, _ = TabletopEnv("rotate", level="L2", domain="eval").reset(seed=11)
    assert frozen(observation) == frozen(expected)
    assert (info["level"], info["domain"], info["seed"]) == ("L2", "eval", 11)


def test_unknown_reset_options_are_refused(rotate: TabletopEnv) -> None:
    with pytest.raises(ConfigError, match="no option sede"):
        rotate.reset(options={"sede": 1})
    with pytest.raises(ConfigError, match="no option 1, sede"):
        rotate.reset(options={"sede": 1, 1: 2})
    with pytest.raises(ConfigError, match="options is a int; give None or a mapping with 'episode'"):
        rotate.reset(options=5)
    with pytest.raises(ConfigError, match="give an Episode"):
        rotate.reset(options={"episode": 3})


def test_a_reset_with_a_bad_seed_is_refused_and_changes_nothing(rotate: TabletopEnv) -> None:
    rotate.reset(seed=3)
    following = rotate.reset()[1]["seed"]
    rotate.reset(seed=3)
    with pytest.raises(ConfigError, match="seed is"):
        rotate.reset(seed=-1)
    assert rotate.episode.seed == 3
    assert rotate.reset()[1]["seed"] == following
    assert rotate.reset(seed=np.int64(4))[1]["seed"] == 4


def test_after_a_reset_that_finds_no_start_no_episode_is_running(monkeypatch: pytest.MonkeyPatch) -> None:
    env = TabletopEnv("rotate")
    env.reset(seed=3)

    def fail(*args: object, **options: object) -> None:
        raise SamplingError("no place")

    monkeypatch.setattr("openvima.env.tabletop.sample_episode", fail)
    with pytest.raises(SamplingError):
        env.reset(seed=4)
    with pytest.raises(EpisodeError, match="call reset"):
        env.step(idle_action())


def test_info_names_what_is_on_the_table(rotate: TabletopEnv) -> None:
    observation, info = rotate.reset(seed=5)
    assert info["prompt"] == rotate.prompt.text == rotate.episode.problem.prompt.text
    assert set(info["objects"]) == {placement.id for placement in rotate.scene.placements}
    seen = set(np.unique(observation["segm"]["top"]).tolist())
    assert set(info["objects"]) <= seen <= set(info["objects"]) | {0, 1, 255}
    assert info["reason"] == ""
    assert info["grasped"] == 0
    decision = rotate.oracle_decision()
    assert rotate.step(decision.action)[4]["grasped"] == decision.pick_id


def test_vector_environments_take_infos_of_hits_and_misses() -> None:
    envs = gymnasium.make_vec("openvima/rotate-v1", num_envs=2, vectorization_mode="sync")
    envs.reset(seed=[5, 5])
    hit = TabletopEnv("rotate")
    hit.reset(seed=5)
    decision = hit.oracle_decision()
    miss = idle_action()
    actions = {key: np.stack([value, miss[key]]) for key, value in decision.action.to_arrays().items()}
    info = envs.step(actions)[4]
    envs.close()
    assert info["grasped"].tolist() == [decision.pick_id, 0]


def test_an_object_thrown_out_of_the_game_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    env = TabletopEnv("rotate")
    env.reset(seed=5)
    lost = Outcome(failure=True, reason="object 5 (red swirl flower) left the workspace")
    progress = env.progress
    monkeypatch.setattr("openvima.env.running_episode.goals.advance", lambda *_: (progress, lost))
    _, reward, terminated, truncated, info = env.step(idle_action())
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info["reason"] == lost.reason


def test_frames_are_recorded_only_in_real_time(rotate: TabletopEnv) -> None:
    realtime = TabletopEnv("rotate", realtime=True)
    results = []
    for env in (rotate, realtime):
        env.reset(seed=6)
        results.append(frozen(env.step(env.oracle_decision().action)))
    assert results[0] == results[1]
    assert rotate.frames == ()
    assert len(realtime.frames) > 10
    assert realtime.frames[0].joints.shape == (6,)
    assert not np.array_equal(realtime.frames[0].joints, realtime.frames[5].joints)


def test_rendering_shows_both_views() -> None:
    env = TabletopEnv("rotate", render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    image = env.render()
    assert np.array_equal(channels_first(image[:128]), observation["rgb"]["front"])
    assert np.array_equal(channels_first(image[128:]), observation["rgb"]["top"])


def test_the_arm_is_shown_only_if_asked_for() -> None:
    hidden, shown = (TabletopEnv("rotate", hide_arm=hide_arm) for hide_arm in (True, False))
    segm = [env.reset(seed=0)[0]["segm"] for env in (hidden, shown)]
    ids = [set(np.unique(views["front"]).tolist()) for views in segm]
    assert ids[0].isdisjoint({2, 3, 4})
    assert 2 in ids[1]


def test_closing_twice_is_fine_and_a_reset_opens_again() -> None:
    env = TabletopEnv("rotate")
    env.close()
    env.close()
    assert env.reset(seed=0)[1]["seed"] == 0


TASK = """
from openvima.tasks import register_task, task_spec
rotate = task_spec("rotate")
for _ in range(2):
    register_task("mine", family="x", template="x.", oracle_max_steps=1, pools=rotate.pools)(rotate.sample)
"""


def output_of(code: str) -> list[str]:
    """What Python prints, which must warn of nothing."""
    command = [sys.executable, "-W", "error", "-c", code]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.stderr == ""
    return result.stdout.split()


@pytest.mark.parametrize(
    "imports", ["import gymnasium, openvima", "import openvima, gymnasium", "import gymnasium"]
)
def test_a_task_has_its_id_whenever_it_is_registered(imports: str) -> None:
    code = (
        f"{imports}{TASK}{imports}\nprint(gymnasium.make('openvima/mine-v1').unwrapped.task, "
        "*(name for name in gymnasium.registry if name.startswith('openvima/')))"
    )
    task, *names = output_of(code)
    assert task == "mine" and sorted(names) == sorted(map(environment_id, [*list_tasks(), "mine"]))


def test_gymnasium_is_imported_as_late_as_possible_and_imports_the_package_that_an_id_names() -> None:
    assert output_of("import openvima, sys; print('gymnasium' in sys.modules)") == ["False"]
    code = "import gymnasium; print(gymnasium.make('openvima:openvima/rotate-v1').unwrapped.task)"
    assert output_of(code) == ["rotate"]
