"""What generating leaves in a folder, and what it makes of folders that hold something already."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from openvima.data import (
    Dataset,
    Demonstration,
    GenerateConfig,
    VerifyConfig,
    generate,
    generation,
    plan,
    verify,
)
from openvima.data.encoding import Skipped
from openvima.data.generation import (
    MAX_EPISODES,
    MAX_FIRST_SEED,
    SEEDS_PER_EPISODE,
    SPARE_SEEDS,
    generate_command,
    shard_episodes,
)
from openvima.data.subsets import MergeConfig, merge
from openvima.env import EnvConfig, TabletopEnv
from openvima.errors import ConfigError, DatasetError, OracleError, SamplingError, UnknownTaskError
from openvima.scene import Outcome
from openvima.tasks.sampling import MAX_SEED
from small_data_sets import TASKS, config, contents, flip_bit


def test_a_folder_holds_shards_index_and_manifest(whole: Path) -> None:
    shards = [f"{task}-train-{number:05d}.arrow" for task in TASKS for number in (0, 1)]
    assert sorted(contents(whole)) == sorted([*shards, "index.parquet", "dataset.json"])
    manifest = json.loads((whole / "dataset.json").read_text())
    assert manifest["counts"]["episodes"] == 6
    assert [entry["episodes"] for entry in manifest["tasks"].values()] == [3, 3]
    assert manifest["config"]["domain"] == "train"
    assert set(manifest["versions"]) == {"openvima", "mujoco", "numba", "numpy", "pyarrow"}


def test_a_finished_folder_is_left_alone(whole: Path) -> None:
    times = {path: path.stat().st_mtime_ns for path in whole.iterdir()}
    generate(config(whole))
    assert {path: path.stat().st_mtime_ns for path in whole.iterdir()} == times


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"level": "L2"}, "level is 'train' there and 'L2' here"),
        ({"start_seed": 5}, "first_seed is 0 there and 5 here"),
        ({"env_config": EnvConfig(prompts="mixed")}, "prompts is 'multimodal' there and 'mixed' here"),
        ({"episodes": 2}, "of its 1 episodes 0 are asked for"),
        ({"episodes": 1}, "of its 2 episodes 1 are asked for"),
        ({"tasks": ("rotate",)}, "of its 2 episodes 0 are asked for"),
        ({"images": False}, "images is True there and False here"),
    ],
)
def test_another_data_set_in_the_folder_is_not_touched(whole: Path, changes: dict, message: str) -> None:
    before = contents(whole)
    with pytest.raises(DatasetError, match=message):
        generate(config(whole, **changes))
    assert contents(whole) == before


def test_force_replaces_a_data_set(tmp_path: Path) -> None:
    generate(config(tmp_path, tasks=("rotate",), episodes=1))
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "broken.json").write_text("[]")  # of an import
    generate(config(tmp_path, tasks=("rotate",), episodes=1, start_seed=7, force=True))
    assert Dataset(tmp_path)[0].seed >= 7
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "broken.json").exists()


def test_seeds_that_fail_are_skipped_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unlucky = {1: SamplingError("no room"), 2: OracleError("lost sight")}
    reset = TabletopEnv.reset

    def sometimes(env: TabletopEnv, *, seed: int, options: dict | None = None) -> tuple:
        if seed in unlucky:
            raise unlucky[seed]
        return reset(env, seed=seed, options=options)

    monkeypatch.setattr(TabletopEnv, "reset", sometimes)
    dataset = Dataset(generate(config(tmp_path, tasks=("rotate",))))
    assert [demo.seed for demo in dataset] == [0, 3, 2 * SEEDS_PER_EPISODE + SPARE_SEEDS]
    entry = dataset.manifest["tasks"]["rotate"]
    assert entry["skipped"] == {"no_action": 1, "not_sampled": 1}
    assert (entry["seeds_tried"], entry["success_rate"]) == (5, 0.6)


def test_a_task_that_the_oracle_cannot_solve_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generation, "attempt", lambda env, seed: Skipped(seed, "no_action", "it fell"))
    with pytest.raises(OracleError, match=r"solved 0 of 20 episodes of 'rotate'.*it fell"):
        generate(config(tmp_path))
    assert contents(tmp_path) == {}


@pytest.fixture
def clumsy(monkeypatch: pytest.MonkeyPatch) -> None:
    """An oracle that spoils seed 0, does not end seeds 1 and 20, and is at a loss at seed 2."""
    rollout = generation.rollout_oracle

    def sometimes(env: TabletopEnv, seed: int) -> Demonstration:
        if seed == 2:
            raise OracleError("lost sight")
        demo = rollout(env, seed)
        outcomes = {0: Outcome(False, True, "it fell"), 1: Outcome(), 20: Outcome()}
        return replace(demo, outcome=outcomes.get(seed, demo.outcome))

    monkeypatch.setattr(generation, "rollout_oracle", sometimes)


@pytest.mark.usefixtures("clumsy")
def test_failed_episodes_are_left_out_and_counted(tmp_path: Path) -> None:
    dataset = Dataset(generate(config(tmp_path / "demos")))
    assert all(demo.outcome.success for demo in dataset)
    assert dataset.manifest["tasks"]["rotate"]["skipped"] == {"failed": 1, "no_action": 1, "unsolved": 2}


def test_every_episode_is_a_solved_one_as_the_environment_shows_it(whole: Path) -> None:
    dataset = Dataset(whole)
    assert len(dataset) == 6
    assert all(demo.outcome.success for demo in dataset)
    demo = dataset[-1]
    env = TabletopEnv(demo.task, level=demo.level, domain=demo.domain)
    observation, _ = env.reset(seed=demo.seed)
    for step, action in enumerate(demo.actions):
        stored = demo.observation(step)
        assert stored["ee"] == observation["ee"]
        assert stored["rgb"]["top"].tobytes() == observation["rgb"]["top"].tobytes()
        assert stored["segm"]["front"].tobytes() == observation["segm"]["front"].tobytes()
        assert demo.scenes[step] == env.scene
        observation, *_ = env.step(action)
    assert env.outcome == demo.outcome
    assert env.prompt.text == demo.prompt.text


def test_a_dataset_can_be_narrowed_to_tasks(whole: Path) -> None:
    dataset = Dataset(whole, tasks=["sweep_without_exceeding"])
    assert len(dataset) == 3
    assert {demo.task for demo in dataset} == {"sweep_without_exceeding"}
    assert dataset.index.num_rows == 3
    with pytest.raises(DatasetError, match="Did you mean 'rotate'"):
        Dataset(whole, tasks=["rotat"])
    with pytest.raises(DatasetError, match=r"no task is named; in .* are rotate, sweep_without_exceeding\."):
        Dataset(whole, tasks=[])


def test_the_index_tells_where_episodes_are(whole: Path) -> None:
    dataset = Dataset(whole)
    row = dataset.index.slice(2, 1).to_pylist()[0]
    assert (row["task"], row["shard"], row["row"]) == ("rotate", "rotate-train-00001.arrow", 0)
    assert dataset[2].content_hash() == row["content_hash"]
    with pytest.raises(IndexError, match="episode 6 of 6"):
        _ = dataset[6]


def test_folders_that_are_no_data_set_are_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="there is no folder"):
        Dataset(tmp_path / "gone")
    with pytest.raises(DatasetError, match="holds no finished data set"):
        Dataset(tmp_path)
    with pytest.raises(DatasetError, match="there is no folder"):
        Dataset(whole / "rotate-train-00000.arrow")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "training").symlink_to(whole)
    with pytest.raises(DatasetError, match=r"but .*/parts/training does\.$"):
        Dataset(tmp_path / "parts")
    (tmp_path / "dataset.json").write_text("{")
    with pytest.raises(DatasetError, match="damaged"):
        Dataset(tmp_path)
    (tmp_path / "dataset.json").write_text('{"schema": 99}')
    with pytest.raises(DatasetError, match="schema 99"):
        Dataset(tmp_path)
    (tmp_path / "dataset.json").write_bytes((whole / "dataset.json").read_bytes())
    with pytest.raises(DatasetError, match=r"index\.parquet is missing"):
        Dataset(tmp_path)


SHARD = "rotate-train-00000.arrow"


@pytest.mark.parametrize("images", [True, False])
def test_extending_copies_what_is_there_and_gives_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, images: bool
) -> None:
    settings = {"tasks": ("rotate",), "shard_size": 4, "images": images}
    whole = contents(generate(config(tmp_path / "whole", episodes=6, **settings)))
    played, attempt = [], generation.attempt

    def counting_attempt(env, seed):
        played.append(seed)
        return attempt(env, seed)

    generate(config(tmp_path / "out", episodes=5, **settings))
    full_shard = (tmp_path / "out" / SHARD).stat().st_ino
    monkeypatch.setattr(generation, "attempt", counting_attempt)
    generate(config(tmp_path / "out", episodes=6, **settings))
    assert contents(tmp_path / "out") == whole
    assert len(played) == 1
    assert (tmp_path / "out" / SHARD).stat().st_ino == full_shard


def test_a_damaged_record_is_not_copied_into_a_larger_shard(tmp_path: Path) -> None:
    settings = {"tasks": ("rotate",), "shard_size": 4}
    generate(config(tmp_path, episodes=3, **settings))
    flip_bit(tmp_path / SHARD, Dataset(tmp_path).index.column("offset")[1].as_py() + 5000)
    content = (tmp_path / SHARD).read_bytes()
    with pytest.raises(DatasetError, match="record 1 "):
        generate(config(tmp_path, episodes=4, **settings))
    assert (tmp_path / SHARD).read_bytes() == content


TEXT = EnvConfig(prompts="text")


def config_of_text_prompts(out: Path, env_config: EnvConfig = TEXT, images: bool = True) -> GenerateConfig:
    return GenerateConfig(
        out=out, tasks=("rotate",), episodes=2, shard_size=2, env_config=env_config, images=images
    )


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A data set with text prompts, and the same with published ones."""
    root = tmp_path_factory.mktemp("data")
    return generate(config_of_text_prompts(root / "text")), generate(
        config_of_text_prompts(root / "multimodal", EnvConfig())
    )


def test_text_takes_the_place_of_images_and_is_recorded_only_then(folders: tuple[Path, Path]) -> None:
    text, multimodal = map(Dataset, folders)
    assert text.manifest["config"]["prompts"] == text.shard(SHARD).info.prompts == "text"
    assert "prompts" not in multimodal.manifest["config"]
    assert b'"prompts"' not in b"".join(multimodal.shard(SHARD).info.to_metadata().values())
    assert multimodal.shard(SHARD).info.prompts == "multimodal"
    for demo, published in zip(text, multimodal, strict=True):
        assert not demo.prompt.images and published.prompt.images
        assert demo.prompt.text.startswith("Rotate the ") and "{" not in demo.prompt.text
        assert (demo.seed, demo.scenes) == (published.seed, published.scenes)


def test_episodes_are_replayed_and_images_rendered_again(folders: tuple[Path, Path], tmp_path: Path) -> None:
    lean = generate(config_of_text_prompts(tmp_path / "lean", images=False))
    for folder in (folders[0], lean):
        found = verify(folder, VerifyConfig(replay=None))
        assert not found.problems and found.num_replayed == 2
    assert [demo.prompt.text for demo in Dataset(lean)] == [demo.prompt.text for demo in Dataset(folders[0])]


def test_episodes_that_two_forms_leave_equal_are_merged_once(tmp_path: Path) -> None:
    every, half = (
        generate(
            GenerateConfig(
                out=tmp_path / p, tasks=("rearrange",), episodes=2, env_config=EnvConfig(prompts=p)
            )
        )
        for p in ("multimodal", "mixed")
    )
    with pytest.raises(DatasetError, match="2 episodes repeat others"):
        merge(MergeConfig((every, half), tmp_path / "refused"))
    merged = merge(MergeConfig((every, half), tmp_path / "merged", duplicates="skip"))
    assert len(Dataset(merged)) == 2


def test_shards_grow_with_their_number() -> None:
    sizes = [shard_episodes(number) for number in range(36)]
    assert sizes[:9] == [4, 4, 4, 4, 8, 8, 8, 8, 16]
    assert sizes[28:] == [512, 512, 512, 512, 1000, 1000, 1000, 1000]
    assert shard_episodes(10**9) == 1000
    assert {shard_episodes(number, 7) for number in range(36)} == {7}


@pytest.mark.parametrize("shard_size", [None, 3])
@pytest.mark.parametrize(("fewer", "more"), [(1, 2), (4, 5), (16, 17), (250, 6000)])
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
    command = generate_command(Path("my demos"), record)
    for words in ("--out 'my demos'", "--level L1", "--seed 5", "--task-options difficulty=hard", "--compat"):
        assert words in command
    for words in ("--compression zstd", "--no-images"):
        assert words in command


def test_settings_are_checked_together(tmp_path: Path) -> None:
    for episodes, seed, workers in ((0, -1, 0), (10**19, 2**63, 10**6)):
        beyond = rf"episodes is {episodes};.* seed is {seed};.* workers is {workers};"
        with pytest.raises(ConfigError, match=beyond):
            config(tmp_path, episodes=episodes, start_seed=seed, workers=workers)
    with pytest.raises(UnknownTaskError, match="rotate"):
        plan(config(tmp_path, tasks=("rotat",)))
    with pytest.raises(ConfigError, match="no level 'L9'"):
        plan(config(tmp_path, level="L9"))
