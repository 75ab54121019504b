"""What consoles and notebooks show of public objects: a screenful, escaped, with and without Jinja."""

from typing import Any

import pytest

from openvima import TabletopEnv
from openvima.data import Dataset, GenerateConfig, generate
from openvima.evaluation import EpisodeOutcome, EvaluationConfig, Results, Row
from openvima.scene import Prompt

MANY = 200
MAX_CHARACTERS = 1000


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One object of each kind that notebooks show."""
    folder = tmp_path_factory.mktemp("my runs") / "a <b>"
    dataset = Dataset(generate(GenerateConfig(folder, tasks=("rotate",), episodes=2)))
    env = TabletopEnv("rotate")
    env.reset(seed=1)
    rows = [
        Row("mine <b>", "rotate", "L1", 1, (EpisodeOutcome(0, True, 1),), ablation) for ablation in ("", "x")
    ]
    return {
        "dataset": dataset,
        "demonstration": dataset[0],
        "environment": env,
        "new environment": TabletopEnv("rotate"),
        "episode": env.episode,
        "prompt": env.episode.problem.prompt,
        "rendered prompt": env.prompt,
        "results": Results(tuple(rows)),
    }


def test_large_records_fit_a_screen() -> None:
    outcomes = tuple(EpisodeOutcome(seed, seed % 2 == 0, 2) for seed in range(MANY))
    levels = ("L1", "L2")
    rows = tuple(Row(f"policy {n}", f"task {n}", level, 1, outcomes) for n in range(50) for level in levels)
    names = tuple(f"task {n}" for n in range(MANY))
    for record in (rows[0], Results(rows), GenerateConfig("out", names), EvaluationConfig(names)):
        assert type(record).__name__ in repr(record) and len(repr(record)) <= MAX_CHARACTERS


WITH_IMAGES = ("demonstration", "environment", "rendered prompt")
KINDS = (*WITH_IMAGES, "dataset", "new environment", "episode", "prompt", "results")


@pytest.mark.parametrize("kind", KINDS)
def test_notebooks_show_a_small_fragment(kind: str, shown: dict[str, Any]) -> None:
    html = shown[kind]._repr_html_()
    assert html.strip().startswith("<div") and html.strip().endswith("</div>")
    assert len(html) < 150_000
    assert len(repr(shown[kind])) <= MAX_CHARACTERS
    assert ("data:image/png;base64," in html) == (kind in WITH_IMAGES)
    assert "http" not in html


def test_names_are_escaped_and_numbers_shown(shown: dict[str, Any]) -> None:
    assert "mine &lt;b&gt;, x" in shown["results"]._repr_html_()
    assert "a &lt;b&gt;" in shown["dataset"]._repr_html_()
    prompt = Prompt("Say <i> {a}.", shown["prompt"].images[:0])
    assert "Say &lt;i&gt;" in (prompt._repr_html_() or "")
