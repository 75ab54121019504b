"""Results: reading, writing, merging."""

import json
from dataclasses import replace

import pytest

from openvima.atomic_io import atomic_write_file
from openvima.cli.evaluate import _print_scores
from openvima.errors import ConfigError, DatasetError
from openvima.evaluation.comparison import merge
from openvima.evaluation.results import EpisodeOutcome, Results, Row, failure_kind
from openvima.evaluation.statistics import wilson_interval


def test_rows_hold_what_scripts_rely_on(results):
    content = json.loads(results.to_json())
    row = content["rows"][0]
    assert content["schema"] == 1
    assert (row["policy"], row["task"], row["level"]) == ("mine", "rotate", "L1")
    assert (row["successes"], row["episodes"]) == (9, 10)
    assert row["interval"] == pytest.approx(wilson_interval(9, 10), abs=1e-6)
    assert row["seeds"] == [0, 9]
    assert row["failures"] == {"object left the workspace": 1}
    assert row["mean_steps"] == 2.0
    assert len(row["outcomes"]) == 10


def test_strict_successes_leave_out_those_slower_than_the_oracle_may_be_in_their_episode_or_row():
    quick, slow = EpisodeOutcome(0, True, 1), EpisodeOutcome(1, True, 3)
    long = EpisodeOutcome(2, True, 3, oracle_max_steps=3)
    row = Row("mine", "rotate", "L1", 1, (quick, slow, long))
    assert (row.successes, row.successes_oracle_horizon) == (3, 2)


def test_rows_under_ablations_stand_beside_the_plain_ones(results):
    plain = results.rows[0]
    under = Row("mine", "rotate", "L1", 1, plain.outcomes[5:], "no_prompt")
    both = Results((*results.rows, under), results.config, results.versions, results.policies)
    assert both.row("mine", "rotate", "L1") == plain
    assert both.row("mine", "rotate", "L1", "no_prompt") == under
    means = {(mean.policy, mean.level, mean.ablation): mean.mean for mean in both.level_means()}
    assert means["mine", "L1", "no_prompt"] == pytest.approx(0.8)
    assert means["mine", "L1", ""] == pytest.approx(0.75)
    assert means["mine", "L3", ""] == pytest.approx(0.3)
    assert both.level_means()[0].tasks == ("rotate", "stack<b>")
    assert json.loads(both.to_json())["rows"][-1]["ablation"] == "no_prompt"


def test_tasks_that_are_mostly_solved_without_a_prompt_are_named(results, tmp_path, capsys):
    solved, lost = EpisodeOutcome(0, True, 1), EpisodeOutcome(0, False, 1)

    def row(task, outcomes, ablation="no_prompt"):
        return Row("mine", task, "L1", 1, tuple(replace(o, seed=k) for k, o in enumerate(outcomes)), ablation)

    rows = (
        row("put_between", [solved] * 19 + [lost]),
        row("rotate", [solved] * 5 + [lost] * 15),
        row("twist", [solved]),  # too few episodes to say so
        row("follow_order", [solved] * 20, "scrambled_words"),
    )
    found = Results(rows, results.config, results.versions, results.policies)
    found.write(tmp_path / "results.json")
    _print_scores(found, tmp_path / "results.json", as_json=False)
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        "Warning: prompts are hardly needed: without one mine solves put_between, L1, in 19 of 20 episodes."
    )
    assert not results.unneeded_prompts()


def test_written_results_are_read_back_equal(results, tmp_path):
    path = results.write(tmp_path / "new" / "results.json")
    assert Results.read(path) == results
    assert Results.read(path.parent) == results
    assert path.read_text() == results.to_json()


def test_missing_results_say_which_command_makes_them(tmp_path):
    with pytest.raises(DatasetError, match="openvima evaluate --out"):
        Results.read(tmp_path)


def test_damaged_results_and_those_of_another_schema_are_refused(tmp_path):
    for text in ("", "{", "[1]", '{"schema": 1}', '{"schema": 1, "rows": [{}]}', '{"schema": 2}'):
        (tmp_path / "results.json").write_text(text)
        with pytest.raises(DatasetError, match="schema 2" if "2" in text else "is damaged"):
            Results.read(tmp_path)


def test_a_failed_write_leaves_the_old_file_and_no_temporary_one(tmp_path):
    path = atomic_write_file(tmp_path / "a.json", "old")
    with pytest.raises(UnicodeEncodeError):
        atomic_write_file(path, "\ud800")
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize(
    ("reason", "kind"),
    [
        ("object 6 (red letter A) left the workspace", "object left the workspace"),
        (
            "distractor object 7 (gold heart) is within 0.1 m of the target of object 5 (blue bowl)",
            "distractor object is within 0.1 m of the target of object",
        ),
        ("", "unknown"),
    ],
)
def test_equal_causes_of_different_objects_count_as_one(reason, kind):
    assert failure_kind(reason) == kind


def test_a_number_that_is_not_finite_is_not_written(results, tmp_path):
    hostile = replace(results, policies={"a": {"kind": "remote", "metadata": {"score": float("nan")}}})
    with pytest.raises(ValueError, match="JSON compliant"):
        hostile.write(tmp_path / "results.json")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def other(results) -> Results:
    """Another training of `mine`, beside the same oracle and random policy."""
    rows = tuple(
        replace(row, outcomes=tuple(replace(o, success=False, kind="x", reason="x") for o in row.outcomes))
        if row.policy == "mine"
        else row
        for row in results.rows
    )
    policies = {**results.policies, "mine": {"kind": "run", "sha256": "cd" * 32}}
    return replace(results, rows=rows, policies=policies)


def test_one_evaluation_stays_as_it_is(results):
    merged = merge({"first": results})
    assert merged.results == results
    assert merged.notes == ()


def test_different_policies_of_one_name_get_that_of_their_evaluation(results, other):
    merged = merge({"first": results, "second": other})
    assert merged.results.policy_names() == ["mine@first", "oracle", "random", "mine@second"]
    assert merged.names["second"]["mine"] == "mine@second"
    assert merged.results.policies["mine@second"]["sha256"] == "cd" * 32
    assert merged.results.row("mine@first", "rotate", "L1").successes == 9
    assert merged.results.row("mine@second", "rotate", "L1").successes == 0
    assert merged.results.row("oracle", "rotate", "L1").episodes == 10  # joined, and not counted twice


def test_more_episodes_of_the_same_policy_are_added(results):
    later = tuple(
        replace(row, outcomes=tuple(EpisodeOutcome(o.seed + 10, True, 1) for o in row.outcomes))
        for row in results.rows
    )
    joined = merge({"a": results, "b": replace(results, rows=later)}).results.row("mine", "rotate", "L1")
    assert [outcome.seed for outcome in joined.outcomes] == list(range(20))
    assert joined.successes == 19


def test_a_contradiction_means_that_the_policies_differ(results, other):
    same_record = replace(other, policies=results.policies)
    merged = merge({"a": results, "b": same_record})
    assert {"mine@a", "mine@b", "oracle"} <= set(merged.results.policy_names())


def test_other_settings_stand_for_other_episodes_and_are_refused(results):
    other, text = (
        replace(results, config={**results.config, **changes})
        for changes in ({"assets": "original"}, {"prompts": "text"})
    )
    with pytest.raises(ConfigError, match=r"assets is procedural in a, original in b"):
        merge({"a": results, "b": other})
    with pytest.raises(ConfigError, match=r"prompts is multimodal in a, text in b"):
        merge({"a": results, "b": text})
    assert merge({"a": text, "b": text}).results.config["prompts"] == "text"


def test_other_versions_are_noted(results):
    newer = replace(results, versions={**results.versions, "mujoco": "2.0"})
    merged = merge({"a": results, "b": newer})
    assert merged.results.versions["mujoco"] == "1.2.3 / 2.0"
    assert "mujoco 1.2.3 / 2.0" in merged.notes[0]


def test_files_that_do_not_name_a_setting_had_the_default(results):
    config = {key: value for key, value in results.config.items() if key != "compat"}
    merged = merge({"old": replace(results, config=config), "new": results})
    assert merged.results.policy_names() == results.policy_names()
