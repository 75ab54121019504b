"""Every task file is on the list and agrees with the catalogue."""

import re
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from openvima.catalog import levels_of, pool
from openvima.catalog.partitions import tasks_at
from openvima.errors import ConfigError, UnknownTaskError
from openvima.tasks import list_tasks, register_task, registry, sample_episode, task_spec
from openvima.tasks.registry import MAX_EPISODE_STEPS
from openvima.user_code import load_file

TASKS = list_tasks()


@pytest.mark.parametrize("task", TASKS)
def test_a_task_describes_itself_and_is_defined_where_the_catalogue_has_a_pool_for_it(task: str) -> None:
    spec = task_spec(task)
    assert spec.levels == levels_of(task)
    assert all(spec.pool(level) == pool(task, level) for level in spec.levels)
    assert ("train" in spec.levels) == ("L1" in spec.levels)
    if "train" in spec.levels:
        assert spec.pool("L1") == spec.pool("train")
    assert spec.summary.endswith(".") and spec.template.endswith(".") and spec.families
    assert spec.max_steps <= MAX_EPISODE_STEPS
    assert spec.max_steps == spec.oracle_max_steps + 2


@pytest.mark.parametrize("task", sorted({*TASKS} - {*tasks_at("L7")}))  # a grammar makes those of L7
def test_every_prompt_follows_the_template(task: str) -> None:
    spec = task_spec(task)
    for seed in range(3):
        text = sample_episode(task, level=spec.levels[0], seed=seed).problem.prompt.text
        patterns = [sentence_pattern(sentence) for sentence in sentences(spec.template)]
        for sentence in sentences(text):  # some prompts begin with sentences in any order
            fitting = [pattern for pattern in patterns if re.fullmatch(pattern, sentence)]
            assert fitting, text
            patterns.remove(fitting[0])
        assert not patterns, text


def sentences(text: str) -> list[str]:
    return re.split(r"(?<=\.) ", text)


def sentence_pattern(template: str) -> str:
    pattern = re.escape(template).replace(r"\{", "{").replace(r"\}", "}")
    return re.sub(r"\{(\w+)\}", r"(\\{\1\\}|[\\w -]+)", pattern)


def test_unknown_tasks_and_levels_are_refused() -> None:
    with pytest.raises(UnknownTaskError, match=r"no task 'rotat'\. Did you mean 'rotate'\?"):
        task_spec("rotat")
    with pytest.raises(ConfigError, match="'rotate' is not defined at level L4; use train, L1, L2, L3, L5"):
        task_spec("rotate").pool("L4")
    with pytest.raises(ConfigError, match="no level 'L9'"):
        task_spec("rotate").pool("L9")


CELL = """
from openvima.tasks import register_task, task_spec
rotate = task_spec("rotate")
@register_task("again", family="x", template="{steps}.", oracle_max_steps={steps}, pools=rotate.pools)
def {function}(table):
    return rotate.sample(table)
"""


@pytest.fixture(autouse=True)
def restored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget at the end of a test what it registered."""
    monkeypatch.setattr(registry, "_TASKS", dict(registry._TASKS))


@pytest.mark.parametrize("functions", [("sample", "sample"), ("sample", "renamed")])
def test_code_that_runs_again_replaces_its_own_task(functions: tuple[str, str]) -> None:
    for steps, function in enumerate(functions, 1):
        code = CELL.replace("{steps}", str(steps)).replace("{function}", function)
        exec(compile(code, f"<cell {steps}>", "exec"), {"__name__": "__main__"})
        spec = task_spec("again")
        assert (spec.oracle_max_steps, spec.sample.__name__) == (steps, function)
        assert sample_episode("again", seed=0).oracle_max_steps == steps
    other = compile(CELL.replace("{steps}", "3").replace("{function}", "sample"), "elsewhere.py", "exec")
    with pytest.raises(
        ConfigError, match=r"'again' is registered twice, by __main__ and elsewhere; task names"
    ):
        exec(other, {"__name__": "elsewhere"})
    assert task_spec("again").oracle_max_steps == 2


def test_a_file_under_two_names_and_an_edited_one_replace_their_own_task(tmp_path: Path) -> None:
    file = tmp_path / "cell.py"
    for steps in (1, 2):
        file.write_text(CELL.replace("{steps}", str(steps)).replace("{function}", "sample"), encoding="utf-8")
        load_file(file, what="test")
        exec(compile(file.read_text(encoding="utf-8"), str(file), "exec"), {"__name__": "__main__"})
        assert task_spec("again").oracle_max_steps == steps


def register_own(name: object = "own", **changes: object) -> Callable[[object], object]:
    return register_task(name, **{"family": "x", "template": "x.", "oracle_max_steps": 1} | changes)  # type: ignore[arg-type]


def test_a_new_task_brings_pools_of_known_levels() -> None:
    pools = {"train": pool("rotate", "train")}
    register_own(pools=pools)(sample_episode)
    assert task_spec("own").levels == ("train",)
    with pytest.raises(ValueError, match="registered twice"):
        register_own("rotate", pools=pools)(sample_episode)
    with pytest.raises(ConfigError, match="task 'poolless' has no pools"):
        register_own("poolless")
    with pytest.raises(ConfigError, match="pools of task 'poolless': there is no level 'L9'"):
        register_own("poolless", pools={"L9": pool("rotate", "train")})
    message = r"no end effector for task 'handy': 'hand'\. Allowed: suction, spatula"
    with pytest.raises(ConfigError, match=message):
        register_own("handy", pools=pools, end_effector="hand")
    for name in ("hand task", "", "-x", "a/b", "größe", "x" * 101, 5):
        with pytest.raises(ConfigError, match=r"a task is named .*; give 1 to 100 letters"):
            register_own(name, pools=pools)


def test_a_task_file_that_failed_can_be_loaded_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "broken.py"
    file.write_text(
        "from openvima.tasks import register_task, task_spec\n"
        "rotate, steps = task_spec('rotate'), {'oracle_max_steps': 1}\n"
        "register_task('broken', family='x', template='x.', pools=rotate.pools, **steps)(rotate.sample)\n"
        "1 / 0\n",
        encoding="utf-8",
    )
    monkeypatch.setenv(registry.TASK_FILES_VARIABLE, str(file))
    for _ in range(2):
        with pytest.raises(ConfigError, match="ZeroDivisionError"):
            registry._load_task_files.__wrapped__()
    del registry._TASKS["broken"]


def test_a_broken_plugin_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = EntryPoint("toys", "no_such_module", registry.ENTRY_POINTS)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [broken])
    with pytest.raises(
        ConfigError, match=r"entry point toys = 'no_such_module' of openvima\.tasks raised ModuleNot"
    ):
        registry._load_task_files.__wrapped__()
