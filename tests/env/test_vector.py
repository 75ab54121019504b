"""Vector environments: the bytes of single ones, Gymnasium's autoreset, and refusals that change nothing."""

from collections.abc import Iterator

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import iterate
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import openvima
from faulty_environments import Faulty
from openvima.env import TabletopEnv, stack_actions
from openvima.env.tabletop import MODALITIES
from openvima.env.vector import TabletopVectorEnv
from openvima.errors import ActionError, ConfigError, EpisodeError, UnknownTaskError
from openvima.scene import Action
from task_cases import frozen

CORNER = Action.planar((0.25, -0.5), (0.25, -0.5))  # picks in an empty corner and therefore moves nothing
TASKS = ["rotate", {"task": "visual_manipulation", "level": "L2"}]  # each with a prompt of its own
OPTIONS = {"domain": "eval", "modalities": MODALITIES}


def rows(envs: VectorEnv, observations: dict) -> list[dict]:
    """The observation of each sub-environment, as a single one gives it."""
    return [{**row, "ee": int(row["ee"])} for row in iterate(envs.observation_space, observations)]


def info_of(infos: dict, index: int) -> dict:
    """The info of one sub-environment, as a single one gives it."""
    return {
        key: info_of(values, index) if isinstance(values, dict) else values[index]
        for key, values in infos.items()
        if infos.get(f"_{key}", [False] * 9)[index]
    }


def oracle_actions(envs: VectorEnv) -> dict[str, np.ndarray]:
    return stack_actions([decision.action for decision in envs.call("oracle_decision")])


@pytest.fixture(scope="module", params=[0, pytest.param(2, marks=pytest.mark.slow)])
def pair(request: pytest.FixtureRequest) -> Iterator[VectorEnv]:
    """Two sub-environments of different tasks and levels; tests leave them usable."""
    envs = openvima.make_vec(TASKS, num_workers=request.param, **OPTIONS)
    yield envs
    envs.close()


def assert_same(envs: VectorEnv, batch: tuple, singles: list[tuple]) -> None:
    """Check that a batch of observations, perhaps ends, and infos holds the bytes of single environments."""
    observations, *ends, infos = batch
    assert envs.observation_space.contains(observations)
    for index, (row, (expected, *end, info)) in enumerate(
        zip(rows(envs, observations), singles, strict=True)
    ):
        assert frozen(row) == frozen(expected)
        assert [each[index] for each in ends] == end
        assert frozen(info_of(infos, index)) == frozen(info)


def test_a_batch_holds_the_bytes_of_single_environments(pair: VectorEnv) -> None:
    singles = [TabletopEnv("rotate", **OPTIONS), TabletopEnv(**TASKS[1], **OPTIONS)]
    assert pair.single_observation_space == singles[0].observation_space
    assert pair.single_action_space == singles[0].action_space
    starts = [env.reset(seed=seed) for env, seed in zip(singles, [4, 9], strict=True)]
    assert_same(pair, pair.reset(seed=[4, 9]), starts)
    assert frozen(pair.get_attr("prompt")) == frozen([env.prompt for env in singles])
    for actions in ([CORNER, CORNER], [env.oracle_decision().action for env in singles]):
        assert stack_actions(actions) in pair.action_space
        results = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        assert_same(pair, pair.step(stack_actions(actions)), results)


def test_returned_observations_stay_as_they_were(pair: VectorEnv) -> None:
    results = [pair.reset(seed=[4, 9])[0]]
    before = [frozen(results[0])]
    for actions in (oracle_actions(pair), IDLE):  # the second starts episodes
        results.append(pair.step(actions)[0])
        before.append(frozen(results[-1]))
    assert frozen(results) == before
    assert len(set(map(str, before))) == 3


IDLE = stack_actions([CORNER, CORNER])


def with_row(key: str, value: object) -> dict[str, np.ndarray]:
    """Two idle actions, of which the second is changed."""
    rows = IDLE[key].copy()
    rows[1] = value
    return IDLE | {key: rows}


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (with_row("pose0_position", np.nan), r"sub-environment 1: pose0_position is \(nan, nan\)"),
        (IDLE | {"gripper": 1}, r"'gripper': \(\)}; give .*'pose0_position': \(2, 2\)"),
        (
            {key: rows[:1] for key, rows in IDLE.items()},
            r"'pose0_position': \(1, 2\).*'pose0_position': \(2, 2\).* a row for each sub-environment",
        ),
        (IDLE | {"pose0_rotation": 1.0}, r"'pose0_rotation': \(\)"),
        (IDLE | {"pose0_rotation": np.eye(2)}, r"'pose0_rotation': \(2, 2\).* 'pose0_rotation': \(2, 4\)"),
        ([CORNER, CORNER], "the form list; give"),
    ],
)
def test_a_batch_with_a_bad_action_moves_nothing_anywhere(
    pair: VectorEnv, actions: dict, message: str
) -> None:
    pair.reset(seed=[4, 9])
    before = pair.get_attr("scene")
    with pytest.raises(ActionError, match=message + ".*Nothing was moved"):
        pair.step(actions)
    assert pair.get_attr("scene") == before
    assert pair.step(oracle_actions(pair))[1].tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seed": -1}, "seed is -1"),
        ({"seed": [1, 2.5]}, "seed is 2.5"),
        ({"seed": [1, 2, 3]}, "3 seeds for 2 sub-environments"),
        ({"seed": 2**63 - 1}, "seed is 9223372036854775808"),
        ({"options": 5}, "options is a int; give None or a mapping with 'reset_mask'"),
        ({"options": {1: 2, "mask": [True]}}, "no option 1, mask"),
        ({"options": {"reset_mask": np.zeros(2, bool)}}, "at least one True"),
        ({"options": {"reset_mask": [True, False]}}, "dtype bool"),
    ],
)
def test_a_bad_reset_is_refused_and_changes_nothing(pair: VectorEnv, arguments: dict, message: str) -> None:
    pair.reset(seed=[4, 9])
    with pytest.raises(ConfigError, match=message):
        pair.reset(**arguments)
    assert [episode.seed for episode in pair.get_attr("episode")] == [4, 9]


def test_before_the_first_reset_and_after_a_step_that_failed_no_step_moves_anything(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mode = AutoresetMode.NEXT_STEP
    envs = TabletopVectorEnv([Faulty, Faulty], [(), ()], mode, 0)
    actions = stack_actions([None, None])
    with pytest.raises(EpisodeError, match=r"0, 1 have no running episode; call reset\(\)"):
        envs.step(actions)
    envs.reset(seed=[1, 2])

    def fail(env: Faulty, action: object) -> None:
        raise ZeroDivisionError

    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(Faulty, "step", fail)
        envs.step(actions)
    with pytest.raises(EpisodeError, match=r"0, 1 have no running episode; call reset\(\)"):
        envs.step(actions)
    envs.reset(seed=[1, 2])
    envs.step(actions)
    envs.step(actions)


def test_a_missing_action_becomes_an_idle_one() -> None:
    arrays = CORNER.to_arrays()
    stacked = stack_actions([arrays, None])
    assert {key: (array.shape, array.dtype) for key, array in stacked.items()} == {
        key: ((2, len(array)), np.dtype(np.float32)) for key, array in arrays.items()
    }
    env = TabletopEnv("rotate")
    env.reset(seed=0)
    before = env.scene
    env.step({key: array[1] for key, array in stacked.items()})
    assert env.scene == before


@pytest.mark.parametrize("num_workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_the_next_step_after_an_end_begins_an_episode(num_workers: int) -> None:
    envs = openvima.make_vec("rotate", 2, num_workers=num_workers, seeds=[3, 4, 5, 6])
    assert envs.reset()[1]["seed"].tolist() == [3, 4]
    oracle = envs.call("oracle_decision")[0].action
    _, rewards, terminated, _, infos = envs.step(stack_actions([oracle, None]))
    assert (rewards.tolist(), terminated.tolist()) == ([1.0, 0.0], [True, False])
    assert infos["seed"].tolist() == [3, 4]
    observations, rewards, terminated, _, infos = envs.step(stack_actions([None, None]))
    assert (rewards.tolist(), terminated.tolist()) == ([0.0, 0.0], [False, False])
    assert infos["seed"].tolist() == [5, 4]
    assert infos["num_steps"].tolist() == [0, 2]
    fresh = TabletopEnv("rotate")
    assert frozen(rows(envs, observations)[0]) == frozen(fresh.reset(seed=5)[0])
    assert frozen(envs.get_attr("prompt")[0]) == frozen(fresh.prompt)
    envs.close()


@pytest.mark.parametrize("num_workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_the_same_step_can_end_an_episode_and_begin_another(num_workers: int) -> None:
    envs = openvima.make_vec(
        "rotate", 2, num_workers=num_workers, seeds=range(3, 7), autoreset_mode="SameStep"
    )
    envs.reset()
    single = TabletopEnv("rotate")
    single.reset(seed=3)
    action = single.oracle_decision().action
    last_observation, *_, last_info = single.step(action)
    observations, rewards, terminated, _, infos = envs.step(stack_actions([action, None]))
    assert (rewards.tolist(), terminated.tolist()) == ([1.0, 0.0], [True, False])
    assert infos["_final_info"].tolist() == infos["_final_obs"].tolist() == [True, False]
    assert frozen(infos["final_obs"][0]) == frozen(last_observation)
    assert frozen(info_of(infos["final_info"], 0)) == frozen(last_info)
    assert (infos["seed"].tolist(), infos["num_steps"].tolist()) == ([5, 4], [0, 1])
    observation, _ = single.reset(seed=5)
    assert frozen(rows(envs, observations)[0]) == frozen(observation)
    assert envs.get_attr("prompt")[0].text == infos["prompt"][0] == single.prompt.text
    envs.close()


@pytest.mark.parametrize("num_workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_without_autoreset_an_ended_episode_waits_for_its_reset(num_workers: int) -> None:
    envs = openvima.make_vec("rotate", 2, num_workers=num_workers, autoreset_mode=AutoresetMode.DISABLED)
    envs.reset(seed=[3, 4])
    oracle = envs.call("oracle_decision")[0].action
    assert envs.step(stack_actions([oracle, None]))[2].tolist() == [True, False]
    with pytest.raises(
        EpisodeError, match=r"sub-environments 0 have no running episode; call reset\(options="
    ):
        envs.step(stack_actions([None, None]))
    observations, infos = envs.reset(seed=[8, None], options={"reset_mask": np.array([True, False])})
    assert (infos["seed"].tolist(), infos["_seed"].tolist()) == ([8, 0], [True, False])
    assert frozen(rows(envs, observations)[0]) == frozen(TabletopEnv("rotate").reset(seed=8)[0])
    assert envs.step(stack_actions([None, None]))[4]["num_steps"].tolist() == [1, 2]
    envs.close()


def test_gymnasiums_wrappers_take_the_infos() -> None:
    envs = DictInfoToList(RecordEpisodeStatistics(openvima.make_vec("rotate", 2)))
    _, infos = envs.reset(seed=[4, 9])
    assert frozen(infos[1]) == frozen(TabletopEnv("rotate").reset(seed=9)[1])
    *_, infos = envs.step(oracle_actions(envs.unwrapped))
    assert [info["episode"]["r"] for info in infos] == [1.0, 1.0]


def test_tasks_and_seeds_are_dealt_in_turn_and_begin_again() -> None:
    envs = openvima.make_vec(TASKS, 3, level="L1", seeds=range(5))
    *_, infos = resets = [envs.reset()[1] for _ in range(3)]
    assert [each["seed"].tolist() for each in resets] == [[0, 1, 2], [3, 4, 2], [0, 1, 2]]
    assert infos["task"].tolist() == ["rotate", "visual_manipulation", "rotate"]
    assert infos["level"].tolist() == ["L1", "L2", "L1"]
    assert envs.reset(seed=[8, None, None])[1]["seed"].tolist() == [8, 4, 2]


@pytest.mark.parametrize("num_workers", [0, 1])
def test_what_cannot_be_built_is_refused_at_once(num_workers: int) -> None:
    def build(tasks: object, *arguments: object, **options: object) -> None:
        openvima.make_vec(tasks, *arguments, num_workers=num_workers, **options)

    with pytest.raises(UnknownTaskError, match="Did you mean 'rotate'"):
        build(["visual_manipulation", "rotat"])
    with pytest.raises(ConfigError, match="L9") as caught:
        build(["rotate", {"task": "rotate", "level": "L9"}], 2)
    assert caught.value.__notes__ == ["raised for sub-environment 1"]
    with pytest.raises(ActionError, match="action 1: "):
        stack_actions([None, {}])
    with pytest.raises(ConfigError, match=r"no option of task 'rotate'.*num_distractors"):
        build("rotate", 2, num_distracters=1)
    with pytest.raises(ConfigError, match="a name, or a mapping with 'task'"):
        build([{"level": "L1"}])
    with pytest.raises(ConfigError, match="1 seeds for 2"):
        build("rotate", 2, seeds=[1])
    with pytest.raises(ConfigError, match="at least one"):
        build("rotate", 0)
    with pytest.raises(ConfigError, match="autoreset mode 'Never'"):
        build("rotate", 1, autoreset_mode="Never")
    with pytest.raises(ConfigError, match="an entry of tasks is 5; give a name, or a mapping with 'task'"):
        build([5])
    with pytest.raises(ConfigError, match="sub-environments 0 and 1 differ in their observation_space"):
        build(["rotate", {"task": "rotate", "control": "end_effector"}])


@pytest.mark.slow
def test_low_level_control_in_batches_gives_the_bytes_of_single_environments() -> None:
    options = {"level": "L1", "control": "end_effector"}
    envs = openvima.make_vec("rotate", 3, num_workers=2, **options)
    single = TabletopEnv("rotate", **options)
    envs.reset(seed=4)
    single.reset(seed=6)
    for _ in range(12):
        commands = np.stack([command.to_array() for command in envs.call("oracle_command")])
        observations, *_ = envs.step(commands)
        expected, *_ = single.step(single.oracle_command())
    assert frozen(rows(envs, observations)[2]) == frozen(expected)
    with pytest.raises(ActionError, match=r"sub-environment 1: .*nan"):
        envs.step(np.where(np.arange(3)[:, None] == 1, np.float32(np.nan), commands))
    with pytest.raises(ActionError, match=r"give arrays of shapes \(3, 5\)"):
        envs.step(stack_actions([CORNER] * 3))
    envs.close()
