"""Comparing policies seed by seed, from results alone."""

from dataclasses import replace

import pytest

from openvima.errors import ConfigError, UnknownPolicyError
from openvima.evaluation.comparison import compare, compare_pairs, default_pairs
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.statistics import PairCounts, mcnemar, mean_difference


def row(policy: str, task: str, level: str, solved: str, first_seed: int = 0, ablation: str = "") -> Row:
    """A row with one letter for each episode, "x" where it was solved."""
    outcomes = (EpisodeOutcome(first_seed + i, letter == "x", 1) for i, letter in enumerate(solved))
    return Row(policy, task, level, 1, tuple(outcomes), ablation)


@pytest.fixture
def found() -> Results:
    rows = (
        row("a", "rotate", "L1", "xxxxxxxx.."),
        row("a", "twist", "L1", "x.x......."),
        row("a", "rotate", "L2", "xx........"),
        row("a", "rotate", "L1", "x.........", ablation="no_prompt"),
        row("b", "rotate", "L1", "x........x"),
        row("b", "twist", "L1", ".xx......."),
        row("b", "rotate", "L2", "xx........"),
    )
    return Results(rows, policies={"a": {"kind": "run"}, "b": {"kind": "random"}})


def test_outcomes_are_paired_by_seed(found):
    rotate = compare(found, "a", "b").tasks[0]
    assert (rotate.level, rotate.task, rotate.pairs) == ("L1", "rotate", (PairCounts(1, 7, 1, 1),))
    assert (rotate.rate_a, rotate.rate_b) == (0.8, 0.2)
    assert rotate.difference == pytest.approx(0.6)
    assert (rotate.p_value, rotate.p_mid) == mcnemar(7, 1)


def test_means_weigh_tasks_alike_and_tests_add_their_counts(found):
    comparison = compare(found, "a", "b")
    level = comparison.levels[0]
    pairs = [PairCounts(1, 7, 1, 1), PairCounts(1, 1, 1, 7)]
    assert (level.difference, level.interval) == mean_difference(pairs)
    assert level.p_value == mcnemar(8, 2)[0]
    assert comparison.overall.difference == pytest.approx((0.6 + 0 + 0) / 3)
    assert [mean.level for mean in comparison.means] == ["L1", "L2", ""]
    assert comparison.levels[1].verdict == comparison.tasks[1].verdict == "noise"  # as many by each


def test_a_clear_difference_names_the_better_one_in_either_order():
    clear = Results((row("a", "rotate", "L1", "x" * 30), row("b", "rotate", "L1", "." * 30)))
    assert compare(clear, "a", "b").overall.verdict == "a"
    assert compare(clear, "b", "a").overall.verdict == "b"


def test_many_comparisons_make_a_single_one_unsure():
    # 8 : 1 is p = 0.039 alone, and one of ten such tasks is to be expected by chance sooner or later
    def results(num_tasks: int) -> Results:
        rows = [row("a", "task0", "L1", "x" * 8 + "." * 4), row("b", "task0", "L1", "." * 8 + "x" + "." * 3)]
        for number in range(1, num_tasks):
            rows += [row(name, f"task{number}", "L1", "x" * 6 + "." * 6) for name in "ab"]
        return Results(tuple(rows))

    assert compare(results(1), "a", "b").tasks[0].verdict == "a"
    crowded = compare(results(10), "a", "b").tasks[0]
    assert crowded.p_holm == pytest.approx(10 * crowded.p_value)
    assert crowded.verdict == "unsure"


def test_p_values_take_the_number_of_pairs_into_account(found):
    more = replace(
        found, rows=(*found.rows, *(replace(r, policy="c") for r in found.rows if r.policy == "b"))
    )
    alone, of_two = compare(found, "a", "b"), compare_pairs(more, [("a", "b"), ("a", "c")])
    assert of_two[0].overall.p_holm == pytest.approx(min(1, 2 * alone.overall.p_value))


def test_a_policy_is_compared_with_itself_under_a_ablation(found):
    comparison = compare(found, "a:no_prompt", "a")
    assert [(d.level, d.task, d.difference) for d in comparison.tasks] == [("L1", "rotate", -0.7)]
    assert comparison.unpaired == 20


def test_only_episodes_that_both_played_count():
    rows = (row("a", "rotate", "L1", "xxxx....", first_seed=4), row("b", "rotate", "L1", "........"))
    comparison = compare(Results(rows), "a", "b")
    assert comparison.overall.pairs == (PairCounts(0, 4, 0, 0),)
    assert comparison.unpaired == 8


def test_policies_without_a_common_episode_are_refused():
    rows = (row("a", "rotate", "L1", "x"), row("b", "rotate", "L1", "x", first_seed=9))
    with pytest.raises(ConfigError, match="no episode in common"):
        compare(Results(rows), "a", "b")
    assert default_pairs(Results(rows)) == []


def test_unasked_the_first_learned_policy_meets_all_but_the_oracle(results):
    assert default_pairs(results) == [("mine", "random")]
    without = Results(results.rows[3:], results.config, results.versions, results.policies)
    assert default_pairs(without) == []


def test_the_record_is_plain_values(found):
    record = compare(found, "a", "b").record()
    assert record["overall"] == {
        "level": "all",
        "task": "mean",
        "episodes": 30,
        "rates": [pytest.approx(0.4), pytest.approx(0.2)],
        "difference": pytest.approx(0.2),
        "interval": [pytest.approx(x, abs=1e-6) for x in compare(found, "a", "b").overall.interval],
        "only_a": 8,
        "only_b": 2,
        "p_mcnemar": mcnemar(8, 2)[0],
        "p_mcnemar_mid": mcnemar(8, 2)[1],
        "p_holm": mcnemar(8, 2)[0],
        "verdict": "noise",
    }


def test_ablations_with_rates_are_named_after_their_policy_and_paired_where_scenes_are_the_same():
    rows = (
        row("a@10:30", "rotate", "L1", "xxxx......"),
        row("a@10:30", "rotate", "L1", "x.........", ablation="masked_words:0.2"),
        row("a@10:30", "rotate", "L1", "xx........", ablation="text_prompts"),
        row("a@10:30", "rotate", "L1", "xxx.......", ablation="num_distractors:2"),
        row("a@10:30", "rotate", "L1", "xx........", ablation="num_distractors:2+masked_words:0.2"),
        row("a", "rotate", "L1", "x.........", ablation="num_distractors:3"),
    )
    results = Results(rows, policies={"a@10:30": {"kind": "run"}, "a": {"kind": "run"}})
    assert compare(results, "a@10:30:masked_words:0.2", "a@10:30").overall.difference == pytest.approx(-0.3)
    assert compare(results, "a@10:30:text_prompts", "a@10:30").overall.difference == pytest.approx(-0.2)
    crowded = "a@10:30:num_distractors:2"
    assert compare(results, f"{crowded}+masked_words:0.2", crowded).overall.difference == pytest.approx(-0.1)
    for other in ("a@10:30", "a:num_distractors:3"):
        with pytest.raises(ConfigError, match="no episode in common"):
            compare(results, crowded, other)
    with pytest.raises(UnknownPolicyError, match=r"Did you mean 'a@10:30:masked_words:0\.2'"):
        compare(results, "a@10:30:masked_word:0.2", "a@10:30")
