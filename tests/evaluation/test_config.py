"""What is played: tasks, levels, seeds, batches, and the names of policies."""

from dataclasses import replace

import pytest

from openvima.env import EnvConfig
from openvima.errors import (
    ConfigError,
    UnknownPolicyError,
)
from openvima.evaluation.config import EvaluationConfig, cells, plan
from openvima.evaluation.runner import evaluate
from openvima.evaluation.sources import policy_sources, weights_hash


def test_every_seed_is_played_once_in_batches_of_the_given_size():
    config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=37, seed=100, batch=16)
    batches = plan(config)
    assert [batch.episodes for batch in batches] == [16, 16, 5]
    assert [seed for batch in batches for seed in batch.seeds] == list(range(100, 137))


def test_all_takes_from_each_level_the_tasks_that_it_holds():
    pairs = cells(EvaluationConfig(("oracle",), levels=("L1", "L3")))
    assert ("sweep_without_exceeding", "L1") in pairs
    assert ("sweep_without_exceeding", "L3") not in pairs
    assert ("rotate", "L3") in pairs


def test_all_leaves_out_tasks_without_a_text_form_where_prompts_are_text():
    text = EnvConfig(prompts="text")
    tasks = {task for task, _ in cells(EvaluationConfig(("oracle",), env_config=text))}
    assert "rotate" in tasks and "rearrange" not in tasks
    assert EvaluationConfig(("oracle",), env_config=text).record()["prompts"] == "text"
    assert "prompts" not in EvaluationConfig(("oracle",)).record()
    with pytest.raises(ConfigError, match="'rearrange' has no text form"):
        cells(EvaluationConfig(("oracle",), ("rotate", "rearrange"), env_config=text))


def test_a_named_task_is_left_out_only_at_levels_without_it():
    tasks = ("rotate", "sweep_without_exceeding")
    pairs = cells(EvaluationConfig(("oracle",), tasks, ("L2", "L3")))
    assert pairs == [("rotate", "L2"), ("sweep_without_exceeding", "L2"), ("rotate", "L3")]


def test_all_problems_of_the_settings_are_named_together():
    with pytest.raises(ConfigError, match=r"episodes is 0.*workers is -1.*policy is empty"):
        EvaluationConfig((), episodes=0, workers=-1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"ablations": ("no_promt",)}, "Did you mean 'no_prompt'"),
        ({"ablations": ("detected_boxes",)}, "needs a detector"),
        ({"precision": "float16"}, "allowed are float64, float32, bfloat16"),
        ({"engine": "threads"}, "allowed are processes and ray"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        EvaluationConfig(("untrained",), **settings)


def test_each_ablation_is_played_by_the_policies_that_it_takes_something_from():
    config = EvaluationConfig(("mine=runs/a", "random"), ("rotate",), ("L1",), episodes=1, ablations=("all",))
    played = [(batch.policy, batch.ablation) for batch in plan(config)]
    mine = ("", "no_prompt", "other_prompt_images", "scrambled_words", "shuffled_objects")
    assert played == [*(("mine", ablation) for ablation in mine), ("random", ""), ("oracle", "")]
    assert config.record()["policies"] == ["mine", "random", "oracle"]


def test_boxes_are_detected_under_their_ablation_only_and_not_by_servers():
    assert EvaluationConfig(("mine=a",), boxes="extractor:make").ablations == ("detected_boxes",)
    policies = ("mine=runs/a", "far=ws://127.0.0.1:8000")
    config = EvaluationConfig(
        policies, ("rotate",), ("L1",), 1, ablations=("all",), boxes="extractor.py:make"
    )
    detected = [batch for batch in plan(config) if batch.boxes]
    assert [(batch.policy, batch.ablation) for batch in detected] == [("mine", "detected_boxes")]


def test_a_ablation_that_changes_nothing_for_any_policy_is_an_error():
    with pytest.raises(ConfigError, match="no_prompt changes nothing for oracle, random"):
        plan(EvaluationConfig(("oracle", "random"), ablations=("no_prompt",)))


@pytest.mark.parametrize(
    ("given", "names", "kinds"),
    [
        ("runs/first,best=runs/second", ["first", "best"], {"run"}),
        ("oracle", ["oracle"], {"oracle"}),
        ("untrained:nano", ["untrained-nano"], {"untrained"}),
        (
            "ws://127.0.0.1:8000,mine=wss://a.example/x?b=c,ws://[::1]:8000/p?q=r",
            ["127.0.0.1-8000", "mine", "1-8000"],
            {"remote"},
        ),
        (
            "lerobot:runs/act_rotate/checkpoints/000020/pretrained_model,lerobot:owner/act@v1,"
            "mine=lerobot:owner/act,lerobot:some/folder",
            ["act_rotate", "act-v1", "mine", "folder"],
            {"lerobot"},
        ),
    ],
)
def test_policies_are_named_after_their_sources_or_as_asked(given, names, kinds):
    sources = policy_sources(given.split(","))
    assert [source.name for source in sources] == names
    assert {source.kind for source in sources} == kinds
    assert all(each.endswith(source.source) for each, source in zip(given.split(","), sources, strict=True))


def test_fresh_weights_are_recorded_with_their_preset():
    sources = policy_sources(("untrained", "untrained:vima-nano"))
    recorded = [{"kind": "untrained"}, {"kind": "untrained", "preset": "vima-nano"}]
    assert [source.record() for source in sources] == recorded


def test_two_policies_of_one_name_are_refused():
    with pytest.raises(ConfigError, match="distinct names"):
        policy_sources(("a/run", "b/run"))


@pytest.mark.parametrize("given", ["../up=run", "a/b=run", "=run", "a b,c=run", "/"])
def test_names_that_are_no_file_names_are_refused(given):
    with pytest.raises(ConfigError, match="NAME=PATH"):
        policy_sources((given,))


@pytest.mark.parametrize(
    ("policy", "error"),
    [
        ("mine=ws://host:port", ConfigError),
        ("mine=ws://", ConfigError),
        ("ws://[", ConfigError),
        ("mine=ws://host:1/\x1b[2J", ConfigError),
        ("mine=http://host:1", UnknownPolicyError),
        ("nowhere/runs/first", UnknownPolicyError),
        ("vima-nano", UnknownPolicyError),
        ("mine=untrained:vima-nona", UnknownPolicyError),
    ],
)
def test_names_of_policies_are_checked_before_any_weights_are_read(monkeypatch, tmp_path, policy, error):
    monkeypatch.setattr("openvima.evaluation.sources.weights_hash", lambda source: pytest.fail("work began"))
    with pytest.raises(error) as refusal:
        evaluate(EvaluationConfig(("openvima-small", policy), ("rotate",), ("L1",), out=tmp_path / "out"))
    assert str(refusal.value).isprintable() and not (tmp_path / "out").exists()


def test_the_hash_of_a_run_changes_with_its_weights_only(tmp_path):
    (tmp_path / "model.safetensors").write_bytes(b"one")
    first = weights_hash(tmp_path)
    (tmp_path / "train.log").write_text("noise")
    assert weights_hash(tmp_path) == first
    (tmp_path / "model.safetensors").write_bytes(b"two")
    assert weights_hash(tmp_path) != first


def test_stored_batches_of_other_weights_or_seeds_have_other_names():
    first, second = plan(EvaluationConfig(("random",), ("rotate",), ("L1",), episodes=2, batch=1))
    batches = (first, replace(first, fingerprint="b"), second)
    assert len({batch.key for batch in batches}) == 3
    assert replace(first, source="elsewhere", may_fail=True).key == first.key
    assert replace(first, ablation="no_prompt").key != first.key
