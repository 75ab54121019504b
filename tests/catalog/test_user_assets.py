"""Assets by the function that makes them; records name it and never run it."""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from openvima.catalog import Pool, load_assets, packs, registration
from openvima.catalog.packs import recorded_assets
from openvima.cli.main import main
from openvima.data import Dataset, GenerateConfig, generate, records, rerender
from openvima.data.verification import VerifyConfig, verify
from openvima.env import EnvConfig, TabletopEnv
from openvima.errors import AssetError, UnknownNameError
from openvima.evaluation import EvaluationConfig, evaluate
from openvima.evaluation.config import plan
from openvima.evaluation.verification import verify_results
from openvima.scene import AtPose, ObjectImage, Pose, Problem, Prompt, Tolerance
from openvima.tasks import TableSampler, register_task, registry
from openvima.tasks.sampling import check_task_options, has_text_form

FILE = Path(__file__).parents[1] / "user_shapes.py"
BAR = f"{FILE}:bar"


@pytest.fixture(autouse=True)
def restored(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    registry.list_tasks()  # loads them
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))
    forget()
    yield
    forget()


def forget() -> None:
    """Undo what the functions did, as another process would find it."""
    packs._packs.clear()
    os.environ.pop(packs._LOADED_VARIABLE, None)
    for cached in (rerender._rasteriser, records.make_env):
        cached.cache_clear()
    for table in (registration.REGISTERED_OBJECTS, registration.REGISTERED_TEXTURES):
        for name in [name for name in table if name.startswith("test ")]:
            del table[name]
    for key in [key for key in registration._CONTENTS if key[1].startswith("test ")]:
        del registration._CONTENTS[key]


def register_bar_task() -> None:
    pools = {"train": Pool(("test bar",), (), ("test gradient",), ())}

    @register_task("move_bar", family="own", template="Move {it}.", oracle_max_steps=1, pools=pools)
    def sample(table: TableSampler, *, goal_y: float = 0.3) -> Problem:
        draw = lambda: ("test bar", "test gradient")  # noqa: E731
        bar = table.place_one("bar", draw, reject=lambda p: p.pose.y > 0)
        goal = AtPose(bar.id, Pose.planar(0.5, goal_y), Tolerance(0.05))
        return Problem(table.scene(), Prompt.parse("Move {it}.", it=ObjectImage(bar)), (goal,))


def test_a_function_registers_assets_once_and_names_the_pack_without_its_folder() -> None:
    pack = load_assets(BAR)
    assert pack.name == "user_shapes.py:bar" and load_assets(BAR) is pack
    assert pack.texture("test gradient").shape == (8, 8, 3) and pack.texture("blue").shape == (1, 1, 3)
    assert pickle.loads(pickle.dumps(pack)) is pack
    assert EnvConfig(assets=BAR).record()["assets"] == "user_shapes.py:bar"


def test_a_record_never_runs_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(FILE.parent)
    with pytest.raises(AssetError, match=r"user_shapes\.py:bar, code that is not run"):
        recorded_assets("user_shapes.py:bar")
    assert "test bar" not in registration.REGISTERED_OBJECTS
    load_assets(BAR)
    assert recorded_assets("/elsewhere/user_shapes.py:bar") == BAR
    assert [recorded_assets(name) for name in ("procedural", "original")] == ["procedural", "original"]


def test_results_never_run_code(tmp_path: Path) -> None:
    register_bar_task()
    config = EvaluationConfig(
        ("oracle",), ("move_bar",), ("train",), 1, out=tmp_path, env_config=EnvConfig(assets=BAR)
    )
    evaluate(config)
    assert verify_results(tmp_path).is_verified  # loaded in this process
    forget()
    with pytest.raises(AssetError, match="code that is not run"):
        verify_results(tmp_path)
    assert verify_results(tmp_path, assets=BAR).is_verified


def test_demonstrations_of_own_assets_are_read_drawn_anew_and_replayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register_bar_task()
    config = GenerateConfig(tmp_path, ("move_bar",), 2, images=False, env_config=EnvConfig(assets=BAR))
    folder = generate(config)
    demo = Dataset(folder)[0]
    assert demo.objects[0].object == "test bar" and demo.assets == "user_shapes.py:bar"
    assert verify(folder, VerifyConfig()).is_clean
    forget()
    monkeypatch.chdir(FILE.parent)  # where the name of the record is a file's
    with pytest.raises(AssetError, match="code that is not run"):
        Dataset(folder)[0].rgb["front"]
    found = verify(folder, VerifyConfig())
    assert any("code that is not run" in problem.cause for problem in found.problems)
    assert "test bar" not in registration.REGISTERED_OBJECTS
    assert verify(folder, VerifyConfig(assets=BAR)).is_clean


def test_runs_check_text_forms_and_options_with_the_assets_of_the_run(tmp_path: Path) -> None:
    register_bar_task()
    has_text_form.cache_clear()
    check_task_options.cache_clear()
    env_config = EnvConfig(assets=BAR, prompts="text", task_options="goal_y=0.2")
    config = EvaluationConfig(("oracle",), ("move_bar",), ("train",), 1, env_config=env_config)
    assert [batch.task for batch in plan(config)] == ["move_bar"]
    forget()
    check_task_options.cache_clear()
    video = tmp_path / "bar.mp4"
    words = ["--policy", "oracle", "--assets", BAR, "--task-options", "goal_y=0.2", "--out", str(video)]
    assert main(["demo", "move_bar", *words]) == 0 and video.is_file()


def test_an_object_that_is_not_registered_is_named_with_the_remedy() -> None:
    register_bar_task()
    env = TabletopEnv("move_bar")
    with pytest.raises(UnknownNameError, match=r"no object 'test bar'.*your own need `register_object`"):
        env.reset(seed=0)


@pytest.mark.slow
def test_workers_load_task_files_and_functions(tmp_path: Path) -> None:
    example = Path(__file__).parents[2] / "examples" / "custom_object.py"
    out = tmp_path / "out"
    script = tmp_path / "script.py"
    script.write_text(
        f"""
if __name__ == "__main__":
    import pathlib
    from openvima.env import EnvConfig
    from openvima.evaluation import EvaluationConfig, Results, evaluate
    config = EvaluationConfig(
        ("oracle",), ("right",), ("train",), 4, batch=2, workers=2, out=pathlib.Path({str(out)!r}),
        env_config=EnvConfig({BAR!r}),
    )
    print(Results.read(evaluate(config)).rows[0].successes)
""",
        encoding="utf-8",
    )
    done = subprocess.run(
        [sys.executable, str(script)],
        env={**os.environ, registry.TASK_FILES_VARIABLE: str(example)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "4", done.stderr
