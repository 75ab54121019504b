"""Task options as text, and distractors in every task that has some."""

import math

import pytest

from openvima.catalog.partitions import PUBLISHED_LEVELS, PUBLISHED_TASKS
from openvima.env.config import EnvConfig
from openvima.errors import ConfigError, UnknownTaskError
from openvima.scene import DistractorsApart, ZoneKeptClear
from openvima.tasks import sample_episode, task_spec
from openvima.tasks.options import MAX_DISTRACTORS, options_of, options_text, parse_options
from openvima.tasks.sampling import check_task_options

WITH_DISTRACTORS = [task for task in PUBLISHED_TASKS if "num_distractors" in task_spec(task).options]
UNCHECKED = ("follow_motion", "follow_order")  # their distractors may be anywhere


def test_a_specific_option_overrides_a_general_one() -> None:
    options = " rotate.num_distractors=2,num_distractors=6 "
    assert options_text(parse_options(options)) == "num_distractors=6,rotate.num_distractors=2"
    assert options_of(task_spec("rotate"), options) == {"num_distractors": 2}
    assert options_of(task_spec("novel_noun"), options) == {"num_distractors": 6}
    assert options_of(task_spec("pick_in_order_then_restore"), options) == {}


def test_settings_keep_options_in_one_spelling_and_record_them_only_if_there_are_any() -> None:
    settings = EnvConfig(task_options="twist.num_distractors=4, difficulty=hard")
    assert settings == EnvConfig(task_options="difficulty=hard,twist.num_distractors=4,")
    assert settings.record()["task_options"] == "difficulty=hard,twist.num_distractors=4"
    assert EnvConfig.from_record(settings.record()) == settings
    assert "task_options" not in EnvConfig().record()
    assert EnvConfig.from_record({"difficulty": "easy"}) == EnvConfig()


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("rotate.angles_deg=30+60", (30.0, 60.0)),
        ("same_shape.after_bowl=true", True),
        ("rearrange.distractor_textures=pool", "pool"),
        ("rotate.num_distractors=3", 3),
    ],
)
def test_values_have_the_type_of_the_option(entry: str, value: object) -> None:
    (found,) = options_of(task_spec(entry.partition(".")[0]), entry).values()
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("num_distractors", r"'num_distractors' is not \[TASK.\]NAME=VALUE"),
        ("a=1,a=2", "a is given twice"),
        (7, "task_options is 7; give text"),
    ],
)
def test_text_of_another_form_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        EnvConfig(task_options=text)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("angle=3", "there is no option of rotate, twist: 'angle'"),
        ("after_bowl=true", "there is no option of rotate, twist: 'after_bowl'"),
        ("rotate.angle=3", "there is no option of task 'rotate': 'angle'. Did you mean 'angles_deg'"),
        ("novel_adj.num_distractors=3", "this run has no novel_adj; its tasks are rotate, twist"),
        ("num_distractors=1.5", "option of 'rotate': num_distractors is 1.5; give an integer"),
        ("num_distractors=03", "is '03'; give an integer"),
        ("num_distractors=true", "num_distractors is True; give an integer"),
        ("rotate.angles_deg=30+x", r"angles_deg is \(30, 'x'\); give angles of more than 15 degrees"),
        ("rotate.angles_deg=NaN", "give angles of more than 15 degrees"),
        ("difficulty=harder", "no difficulty 'harder'. Did you mean 'hard'"),
    ],
)
def test_an_option_that_does_not_fit_the_run_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_task_options(("rotate", "twist"), text)


def test_an_unknown_task_is_suggested() -> None:
    with pytest.raises(UnknownTaskError, match="Did you mean 'rotate'"):
        check_task_options(("rotate",), "rotat.difficulty=hard")


@pytest.mark.parametrize("task", WITH_DISTRACTORS)
def test_every_task_takes_up_to_six_distractors(task: str) -> None:
    level = [level for level in task_spec(task).levels if level in PUBLISHED_LEVELS][-1]
    counts = []
    for count in (0, MAX_DISTRACTORS):
        problem = sample_episode(task, level=level, seed=1, num_distractors=count).problem
        checked = [c for c in problem.constraints if type(c) in (DistractorsApart, ZoneKeptClear)]
        counts.append((len(problem.scene.placements), sum(len(c.object_ids) for c in checked)))
    (fewer, fewer_checked), (more, more_checked) = counts
    assert more - fewer == MAX_DISTRACTORS
    assert more_checked - fewer_checked == (0 if task in UNCHECKED else MAX_DISTRACTORS)
    if task != "manipulate_old_neighbor":  # whose grid has room for 8
        with pytest.raises(ConfigError, match="num_distractors is 7; give an integer from 0 to 6"):
            sample_episode(task, level=level, seed=0, num_distractors=7)


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        *((task, {"difficulty": "hart"}, "no difficulty 'hart'.*'hard'") for task in PUBLISHED_TASKS),
        ("rotate", {"num_distractors": 1.0}, "num_distractors is 1.0"),
        ("rotate", {"angles_deg": (30, 0)}, "give angles of more than 15 degrees"),
        ("rotate", {"angles_deg": (math.nan,)}, "angles_deg"),
        ("rotate", {"angles_deg": (math.inf,)}, "angles_deg is .inf,.; give angles of more"),
        ("rotate", {"angles_deg": 30}, "angles_deg is 30; give angles of more"),
        ("same_shape", {"after_bowl": "no"}, "after_bowl is 'no'; give true or false"),
        ("rearrange_then_restore", {"restore_distractor": "no"}, "restore_distractor is 'no'; give true or"),
        ("rearrange", {"distractor_textures": "pol"}, "'pol'. Did you mean 'pool'"),
    ],
)  # fmt: skip
def test_an_option_out_of_range_is_refused(task: str, options: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        sample_episode(task, level=task_spec(task).levels[0], seed=0, **options)
