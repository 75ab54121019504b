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
    UnknownTaskError,
)
from openvima.render import channels_first
from openvima.scene import Action, Outcome
from openvima.tasks import list_tasks, sample_episode, task_spec
from task_cases import REPRESENTATIVE_TASKS

TASKS = list_tasks()
EVERY_STEP_COUNTS = {"follow_motion", "follow_order"}


def frozen(value: object) -> object:
    """A nested observation, info or result as something that `==` compares byte by byte."""
    if isinstance(value, dict):
        return {key: frozen(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [frozen(entry) for entry in value]
    return (value.shape, value.dtype.str, value.tobytes()) if isinstance(value, np.ndarray) else value


def idle_action() -> dict[str, np.ndarray]:
    """An action that picks in an empty corner and therefore moves nothing."""
    return Action.planar((0.25, -0.5), (0.25, -0.5)).to_arrays()


@pytest.fixture(scope="module")
def rotate() -> TabletopEnv:
    return TabletopEnv("rotate")


@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_nothing_to_complain_about(task: str) -> None:
    env = gymnasium.make(f"openvima/{task}-v1", level=task_spec(task).levels[-1]).unwrapped
    with warnings.catch_warnings():
        # Positions are in metres, as published actions are, and so lie in 0.25 … 0.75 rather than -1 … 1.
        warnings.filterwarnings("ignore", message=".*we recommend using a symmetric and normalized space")
        check_env(env)


@pytest.mark.parametrize("task", sorted(set(TASKS) - EVERY_STEP_COUNTS))
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


@pytest.mark.parametrize("task", sorted(EVERY_STEP_COUNTS))
def test_doing_nothing_useful_fails_where_every_step_counts(task: str) -> None:
    env = TabletopEnv(task)
    env.reset(seed=1)
    _, reward, terminated, truncated, info = env.step(idle_action())
    assert (reward, terminated, truncated) == (0.0, True, False)
    assert info["failure"]
    assert info["reason"]


@pytest.mark.parametrize("task", REPRESENTATIVE_TASKS)
def test_an_environment_that_was_used_gives_the_same_bytes_as_a_fresh_one(task: str) -> None:
    def play(env: TabletopEnv) -> object:
        result = [env.reset(seed=3)]
        result.append(env.step(env.oracle_decision().action))
        images = {name: (image.rgb, image.segm) for name, image in env.prompt.images.items()}
        return frozen([result, images, env.joint_path])

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


def test_names_and_levels_are_checked_when_it_is_made() -> None:
    with pytest.raises(UnknownTaskError, match="Did you mean 'rotate'"):
        TabletopEnv("rotat")
    with pytest.raises(ConfigError, match="L9"):
        TabletopEnv("rotate", level="L9")
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


def wrong(**changes: object) -> dict[str, object]:
    return {**idle_action(), **changes}


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (wrong(pose0_position=np.float32([0.8, 0.1])), r"pose0_position is \(0.8, 0.1\); x must lie in 0.25"),
        (wrong(pose1_position=np.float32([0.5, -0.6])), r"pose1_position is .* y in -0.5 … 0.5 m"),
        (wrong(pose0_rotation=np.float32([0, 0, 0, 1.5])), r"pose0_rotation is .*must lie in -1 … 1"),
        (wrong(pose0_position=np.float32([np.nan, 0.1])), r"pose0_position is \(nan, .*finite"),
        (wrong(pose1_rotation=np.float32([0, 0, np.inf, 1])), r"pose1_rotation is .*finite"),
        (wrong(pose1_position=np.array([1e300, 0])), r"pose1_position is .*finite"),
        (wrong(pose1_rotation=np.float32([0, 0, 1])), r"pose1_rotation has shape \(3,\); it must be \(4,\)"),
        (wrong(pose0_position=np.float32([[0.5, 0]])), r"pose0_position has shape \(1, 2\)"),
        (wrong(pose0_position=np.float32(0.5)), r"pose0_position has shape \(\)"),
        (wrong(pose1_position=np.array([1, 0])), "pose1_position has dtype int64; it must be floating-point"),
        (wrong(pose1_position=np.array(["a", "b"])), "pose1_position has dtype <U1"),
        (wrong(pose1_position=np.complex64([0.5, 0])), "pose1_position has dtype complex64"),
        (wrong(pose0_rotation=None), "pose0_rotation has dtype object"),
        (wrong(pose0_rotation=[[0.0], [0.0, 1.0]]), "pose0_rotation is a list that NumPy cannot convert"),
        ({"pose0_position": np.float32([0.5, 0])}, "pose0_rotation, pose1_position, pose1_rotation missing"),
        ({}, "missing"),
        (wrong(extra=1), "unknown keys extra; allowed are pose0_position"),
        (wrong(**{"pose0_position": np.float32([9, 9]), "extra": 1}), "extra.*pose0_position is"),
        (np.zeros(12, np.float32), "a mapping with keys .* not ndarray"),
        (None, "not NoneType"),
        (3, "not int"),
        pytest.param(
            Action(("a", 0.1), (0.5, 0)),
            r"is Action\(.*'a'.*its values must be numbers",
            id="text as numbers",
        ),
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


def test_domains_and_levels_have_different_episodes() -> None:
    kinds = [("train", "user"), ("train", "eval"), ("L1", "user")]
    observations = [
        TabletopEnv("rotate", level=level, domain=domain).reset(seed=0)[0]["rgb"]["top"].tobytes()
        for level, domain in kinds
    ]
    assert len(set(observations)) == len(kinds)


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


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5])
def test_a_reset_with_a_bad_seed_is_refused_and_changes_nothing(rotate: TabletopEnv, seed) -> None:
    rotate.reset(seed=3)
    following = rotate.reset()[1]["seed"]
    rotate.reset(seed=3)
    with pytest.raises(ConfigError, match="seed is"):
        rotate.reset(seed=seed)
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


def test_the_object_that_was_lifted_is_reported(rotate: TabletopEnv) -> None:
    rotate.reset(seed=5)
    decision = rotate.oracle_decision()
    assert rotate.step(decision.action)[4]["grasped"] == decision.pick_id


def test_vector_environments_take_infos_of_hits_and_misses() -> None:
    envs = gymnasium.make_vec("openvima/rotate-v1", num_envs=2, vectorization_mode="sync")
    envs.reset(seed=[5, 5])
    hit = TabletopEnv("rotate")
    hit.reset(seed=5)
    decision = hit.oracle_decision()
    miss = Action.planar((0.25, -0.5), (0.25, -0.5)).to_arrays()
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


def test_prompts_are_interleaved_and_objects_recorded(rotate: TabletopEnv) -> None:
    rotate.reset(seed=0)
    parts = rotate.prompt.sequence()
    images = [part for part in parts if not isinstance(part, str)]
    assert images
    for image in images:
        assert image.rgb["front"].shape == (3, 128, 256)
        shown = set(np.unique(image.segm["top"]).tolist()) - {0, 1, 255}
        assert shown <= {record.object_id for record in image.objects}


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
    env.reset(seed=0)
    env.close()
    env.close()
    assert env.reset(seed=0)[1]["seed"] == 0


@pytest.mark.parametrize("imports", ["import gymnasium, openvima", "import openvima, gymnasium"])
def test_the_order_of_imports_does_not_matter(imports: str) -> None:
    code = f"{imports}; print(*(name for name in gymnasium.registry if name.startswith('openvima/')))"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    assert sorted(result.stdout.split()) == [environment_id(task) for task in list_tasks()]


TASK = """
from openvima.tasks import register_task, task_spec
rotate = task_spec("rotate")
for _ in range(2):
    register_task("mine", family="x", template="x.", oracle_max_steps=1, pools=rotate.pools)(rotate.sample)
"""


@pytest.mark.parametrize(
    "imports", ["import gymnasium, openvima", "import openvima, gymnasium", "import gymnasium"]
)
def test_a_task_has_its_id_whenever_it_is_registered(imports: str) -> None:
    code = f"{imports}{TASK}{imports}\nprint(gymnasium.make('openvima/mine-v1').unwrapped.task)"
    result = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (result.stdout.strip(), result.stderr) == ("mine", "")


def test_gymnasium_imports_the_package_that_an_id_names() -> None:
    code = "import gymnasium; print(gymnasium.make('openvima:openvima/rotate-v1').unwrapped.task)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "rotate"


def test_openvima_alone_does_not_import_gymnasium() -> None:
    code = "import openvima, sys; print('gymnasium' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"
