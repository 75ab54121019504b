"""Checkpoints pushed to a Hub on this machine, with their cards, and fetched."""

from pathlib import Path

import pytest
import yaml

from local_hub import LocalHub
from openvima.cli.main import main
from openvima.errors import ConfigError
from openvima.evaluation.results import EpisodeOutcome, Results, Row

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=<...>':DeprecationWarning")  # of the client

from openvima.evaluation.sources import PolicySource, weights_hash  # noqa: E402
from openvima.policies import load_policy, preset  # noqa: E402
from openvima.policies.build import build_network  # noqa: E402
from openvima.policies.checkpoint import load_checkpoint, save_checkpoint  # noqa: E402
from openvima.policies.naming import find_checkpoint  # noqa: E402
from openvima.publishing import policy_files, push_policy  # noqa: E402


def policy_card(*args, **options) -> str:
    card = policy_files(*args, **options)["README.md"]
    assert isinstance(card, bytes)
    return card.decode()


SETTINGS = {
    "training": {
        "preset": "nano",
        "seed": 5,
        "schedule": {"steps": 321},
        "loader": {"exclude_tasks": "twist,rotate"},
    },
    "demonstrations": {"episodes": 8765, "held_out": ["follow_order L4"]},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with one checkpoint; nobody trained it."""
    folder = tmp_path_factory.mktemp("runs") / "first"
    checkpoint = folder / "checkpoints" / "2-cloning-000321"
    checkpoint.parent.mkdir(parents=True)
    save_checkpoint(build_network(preset("nano"), seed=0), checkpoint, dtype=torch.float16)
    (folder / "checkpoints" / "best.txt").write_text(checkpoint.name)
    (folder / "config.yaml").write_text(yaml.safe_dump(SETTINGS))
    return folder


@pytest.fixture
def scores(run: Path, tmp_path: Path) -> Path:
    """Results of these weights and of others."""
    outcomes = [EpisodeOutcome(seed, seed < 7, 1, "", "" if seed < 7 else "late") for seed in range(10)]
    rows = [Row(name, "rotate", "L2", 1, tuple(outcomes)) for name in ("mine", "other")]
    policies = {"mine": {"kind": "run", "sha256": weights_hash(run)}, "other": {"kind": "oracle"}}
    results = Results(tuple(rows), {"episodes": 10, "levels": ["L2"]}, {"openvima": "0"}, policies)
    return results.write(tmp_path / "scores" / "results.json").parent


def test_a_pushed_checkpoint_is_loaded_and_scored_by_its_revision(hub: LocalHub, run: Path) -> None:
    pushed = push_policy(run, "owner/first@v1")
    hub.requests.clear()
    assert weights_hash(str(pushed)) == weights_hash(run)
    fetched = {each.rpartition("/")[2] for each in hub.requests if "/resolve/" in each}
    assert fetched == {"model.safetensors", "config.yaml", "vocabulary.json"}
    assert load_policy("owner/first@v1").network.config == load_checkpoint(find_checkpoint(run)).config
    assert PolicySource("first", "owner/first@v1").record()["hub"] == str(pushed)
    hub.repository("owner/first").commit({"model.safetensors": b"other"}, "v1")
    assert weights_hash(str(pushed)) == weights_hash(run) != weights_hash("owner/first@v1")


def test_no_more_is_pushed_than_the_checkpoint(hub: LocalHub, run: Path, scores: Path, capsys) -> None:
    command = ["policies", "push-to-hub", str(run), "owner/first", "--results", str(scores)]
    assert main([*command, "--dry-run"]) == 0
    assert not hub.requests
    assert capsys.readouterr().out == policy_card(run, "owner/first", results=scores)
    assert main(command) == 0
    name, _, revision = capsys.readouterr().out.strip().partition("@")
    assert name == "owner/first"
    assert set(hub.repository("owner/first").commits[revision]) == {
        ".gitattributes",
        "README.md",
        "config.yaml",
        "model.safetensors",
        "results.json",
        "tokenizer/vocabulary.json",
    }


def test_the_card_says_data_settings_and_the_scores_of_these_weights(run: Path, scores: Path) -> None:
    _, metadata, text = policy_card(run, "owner/first@v1", results=scores).split("---\n", 2)
    values = yaml.safe_load(metadata)
    assert (values["license"], values["library_name"]) == ("mit", "openvima")
    shown = (
        "| demonstrations | 8765 |",
        "twist,rotate",
        "follow\\_order L4",
    )
    assert [part for part in (*shown, "321") if part not in text] == []
    assert "| rotate | 70.0 (39.7 to 89.2) |" in text
    assert "openvima evaluate --policy owner/first@v1" in text
    assert "other" not in text.partition("## Scores")[2].partition("## Use")[0]


def test_scores_of_other_weights_are_refused(run: Path, scores: Path, tmp_path: Path) -> None:
    save_checkpoint(build_network(preset("nano"), seed=1), tmp_path / "other")
    with pytest.raises(ConfigError, match="no scores of these weights, only of mine, other"):
        policy_card(tmp_path / "other", "owner/first", results=scores)


def test_without_run_folder_and_results_the_card_says_so(run: Path, tmp_path: Path) -> None:
    save_checkpoint(load_checkpoint(find_checkpoint(run)), tmp_path / "alone")
    card = policy_card(tmp_path / "alone", "owner/first", licence="CC-BY-4.0")
    assert "Not recorded: the checkpoint does not lie in its run folder." in card
    assert "None were pushed with the checkpoint." in card
    assert "license: cc-by-4.0" in card and "Weights: cc-by-4.0." in card


def test_the_bundled_checkpoint_has_a_card_of_its_training(hub: LocalHub) -> None:
    assert "| demonstrations | 52000 |" in policy_card("openvima-small", "owner/small")
