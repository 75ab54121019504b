"""Who does the work, processes, a Ray cluster or the parts of a job array, does not change a byte."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import worker_jobs
from openvima.data import GenerateConfig, generate, plan
from openvima.data.manifest import is_finished
from openvima.errors import ConfigError, MissingExtraError
from openvima.multiprocess import imap_with_engine
from small_data_sets import config, contents


@pytest.fixture(scope="module")
def ray() -> Iterator[ModuleType]:
    """Ray with two processors on this machine."""
    ray = pytest.importorskip("ray")
    try:
        ray.init(
            address="local",
            num_cpus=2,
            include_dashboard=False,
            log_to_driver=False,
            logging_level="ERROR",
            runtime_env={"env_vars": {"PYTHONPATH": str(Path(worker_jobs.__file__).parent)}},
        )
        yield ray
    finally:
        ray.shutdown()
        worker_jobs.forget_ray()


@pytest.mark.slow
def test_two_workers_do_not_change_a_byte(whole: Path, tmp_path: Path) -> None:
    reports: list[tuple[int, int, str]] = []
    generate(config(tmp_path, workers=2), lambda *report: reports.append(report))
    assert contents(tmp_path) == contents(whole)
    assert (reports[0], reports[-1]) == ((0, 6, ""), (6, 6, ""))


@pytest.mark.slow
def test_ray_stopped_by_hand_leaves_whole_files_and_is_continued(
    whole: Path, tmp_path: Path, ray: ModuleType
) -> None:
    def stop(*_: object) -> None:
        if any(tmp_path.rglob("*.arrow")):  # episodes are reported before their file is whole
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(config(tmp_path, workers=2, engine="ray"), stop)
    there = contents(tmp_path)
    assert there
    assert there.items() <= contents(whole).items()
    generate(config(tmp_path, workers=2, engine="ray"))
    assert contents(tmp_path) == contents(whole)
    assert ray.is_initialized()  # as it was found


@pytest.mark.slow
def test_a_job_of_ray_whose_worker_was_killed_runs_again(ray: ModuleType, tmp_path: Path) -> None:
    paths = [tmp_path / str(k) for k in range(3)]
    done = list(imap_with_engine("ray", worker_jobs.die_at_first, paths, 2))
    assert sorted(item for item, _ in done) == paths
    assert [path.read_text() for path in paths] == ["done"] * 3


def test_without_ray_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install openvima\[scale\]"):
        generate(config(tmp_path, engine="ray"))


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:9", r"no Ray cluster answers at 127\.0\.0\.1:9"),
        ("nowhere", "no Ray cluster answers at nowhere .*HOST:PORT"),
    ],
)
def test_a_cluster_that_does_not_answer_is_named(address: str, message: str) -> None:
    pytest.importorskip("ray")
    with pytest.raises(ConfigError, match=message):
        list(imap_with_engine("ray", worker_jobs.fail, [0], None, address=address))


def test_ranges_of_shards_in_any_order_make_the_same_data_set(whole: Path, tmp_path: Path) -> None:
    names = [block.path.name for block in plan(config(tmp_path))]
    reports: list[tuple[int, int, str]] = []
    generate(config(tmp_path, shard_range=(1, 3)), lambda *report: reports.append(report))
    assert sorted(contents(tmp_path)) == names[1:3]
    assert reports[-1] == (3, 3, "")
    for shard_range in ((3, 9), (0, 1)):
        assert not is_finished(tmp_path)
        generate(config(tmp_path, shard_range=shard_range))
    assert contents(tmp_path) == contents(whole)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shard_range": (2, 2)}, "shard_range is 2:2; it must be a:b"),
        ({"shard_range": (-1, 2)}, "shard_range is -1:2"),
        ({"engine": "slurm"}, "engine is 'slurm'; allowed are processes and ray"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(changes: dict, message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        config(tmp_path, **changes)


def test_large_shards_are_handed_out_first(tmp_path: Path) -> None:
    asked = GenerateConfig(out=tmp_path, tasks=("rotate",), episodes=21)
    order: list[str] = []

    def note(*_: object) -> None:
        order.extend(sorted({path.name for path in tmp_path.glob("*.arrow")} - set(order)))

    generate(asked, note)
    sizes = {block.path.name: block.episodes for block in plan(asked)}
    assert [sizes[name] for name in order] == [5, 4, 4, 4]  # the fifth ends after the last report
