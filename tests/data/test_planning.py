"""The division of work into shards: it depends on the settings alone, and more episodes extend it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from openvima.data import GenerateConfig, plan
from openvima.data.planning import MAX_EPISODES, MAX_FIRST_SEED, generate_command, shard_episodes
from openvima.env import EnvConfig
from openvima.errors import ConfigError, UnknownTaskError
from openvima.tasks.sampling import MAX_SEED
from small_data_sets import config


def test_shards_grow_with_their_number() -> None:
    sizes = [shard_episodes(number) for number in range(36)]
    assert sizes[:9] == [4, 4, 4, 4, 8, 8, 8, 8, 16]
    assert sizes[28:] == [512, 512, 512, 512, 1000, 1000, 1000, 1000]
    assert shard_episodes(10**9) == 1000
    assert {shard_episodes(number, 7) for number in range(36)} == {7}


@pytest.mark.parametrize("shard_size", [None, 3])
@pytest.mark.parametrize(("fewer", "more"), [(1, 2), (4, 5), (16, 17), (23, 300), (250, 6000)])
def test_more_episodes_begin_with_the_shards_of_fewer(
    tmp_path: Path, shard_size: int | None, fewer: int, more: int
) -> None:
    asked = GenerateConfig(out=tmp_path, tasks=("rotate",), episodes=fewer, shard_size=shard_size)
    small, large = plan(asked), plan(replace(asked, episodes=more))
    assert large[: len(small) - 1] == small[:-1]
    last, grown = small[-1], large[len(small) - 1]
    assert (last.path, last.info, last.seeds[0]) == (grown.path, grown.info, grown.seeds[0])
    assert last.episodes <= grown.episodes
    assert sum(block.episodes for block in small) == fewer
    assert sum(block.episodes for block in large) == more


def test_shards_share_no_seeds(tmp_path: Path) -> None:
    blocks = plan(GenerateConfig(out=tmp_path, tasks=("rotate",), episodes=3000, start_seed=17))
    seeds = [seed for block in blocks for seed in block.seeds]
    assert len(seeds) == len(set(seeds))
    assert seeds[0] == 17
    assert all(len(block.seeds) > 4 * block.episodes for block in blocks)


def test_there_are_seeds_for_all_that_may_be_asked_for(tmp_path: Path) -> None:
    asked = GenerateConfig(
        out=tmp_path, tasks=("rotate",), episodes=MAX_EPISODES, shard_size=999, start_seed=MAX_FIRST_SEED
    )
    assert plan(asked)[-1].seeds[-1] <= MAX_SEED


def test_a_large_data_set_has_few_files(tmp_path: Path) -> None:
    blocks = plan(GenerateConfig(out=tmp_path, episodes=40_000))
    num_tasks = len({block.info.task for block in blocks})
    assert len(blocks) < 70 * num_tasks


def test_who_does_the_work_does_not_matter(tmp_path: Path) -> None:
    blocks = plan(config(tmp_path))
    for changes in ({"workers": 5}, {"engine": "ray"}, {"shard_range": (1, 2)}):
        assert plan(config(tmp_path, **changes)) == blocks


def test_the_command_of_a_record_has_its_settings(tmp_path: Path) -> None:
    asked = config(
        tmp_path,
        level="L1",
        start_seed=5,
        env_config=EnvConfig(compat=True, task_options="difficulty=hard"),
        compression="zstd",
        images=False,
    )
    record = json.loads(json.dumps(asked.record()))
    assert str(tmp_path) not in json.dumps(record)
    command = generate_command(Path("my demos"), record, keep_failed=True)
    for words in ("--out 'my demos'", "--level L1", "--seed 5", "--task-options difficulty=hard", "--compat"):
        assert words in command
    for words in ("--compression zstd", "--no-images", "--keep-failed"):
        assert words in command


def test_a_level_that_does_not_exist_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no level 'L9'"):
        GenerateConfig(tmp_path, level="L9").resolved_tasks()


def test_settings_are_checked_together(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"episodes is 0.*workers is 0"):
        config(tmp_path, episodes=0, workers=0)
    with pytest.raises(UnknownTaskError, match="rotate"):
        plan(config(tmp_path, tasks=("rotat",)))
    with pytest.raises(ConfigError):
        plan(config(tmp_path, level="L7"))


@pytest.mark.parametrize(("name", "value"), [("episodes", 10**19), ("start_seed", 2**63), ("workers", 10**6)])
def test_numbers_beyond_all_reason_are_refused(name: str, value: int, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"is {value}; it must lie within"):
        GenerateConfig(out=tmp_path, **{name: value})
