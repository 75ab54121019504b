"""Joining evaluations."""

from dataclasses import replace

import pytest

from openvima.errors import ConfigError
from openvima.evaluation.comparison import merge
from openvima.evaluation.results import EpisodeOutcome, Results


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


def test_the_same_policy_is_joined_and_not_counted_twice(results, other):
    merged = merge({"first": results, "second": other})
    assert merged.results.row("oracle", "rotate", "L1").episodes == 10


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
    config = {**results.config, "assets": "original"}
    with pytest.raises(ConfigError, match=r"assets is procedural in a, original in b"):
        merge({"a": results, "b": replace(results, config=config)})


def test_other_prompts_are_refused_and_published_ones_need_no_name(results):
    text = replace(results, config={**results.config, "prompts": "text"})
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
