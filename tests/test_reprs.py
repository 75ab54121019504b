"""What consoles and notebooks show of public objects: a screenful, escaped, with and without Jinja."""

import importlib
import inspect
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

from openvima import TabletopEnv
from openvima.data import Dataset, GenerateConfig, generate
from openvima.evaluation import EpisodeOutcome, Results, Row
from openvima.scene import Prompt

PACKAGES = ("", ".data", ".evaluation", ".env", ".tasks", ".scene", ".policies", ".serving")
MANY = 200
MAX_CHARACTERS = 1000


def large(hint: Any) -> Any:
    """Return a value of a type, with many items where the type leaves their number open."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if isinstance(hint, type) and is_dataclass(hint):
        return large_record(hint)
    if origin in (typing.Union, types.UnionType):
        return max((large(arg) for arg in args), key=lambda value: len(repr(value)))
    if origin is tuple and args[-1] is not ...:
        return tuple(map(large, args))
    if hint is tuple or origin in (tuple, list, set, frozenset, Sequence):
        return (large(args[0]) if args else 12345,) * MANY
    if hint is dict or origin in (dict, Mapping):
        return {f"key {number}": large(args[1]) if args else 12345 for number in range(MANY)}
    known = {np.ndarray: np.zeros((3, 9, 9)), str: "some words", int: 12345, float: 0.123456789, bool: True}
    return known.get(hint)


def large_record(kind: type) -> object:
    """Return an instance of a dataclass with large values, which nothing has checked."""
    try:
        hints = typing.get_type_hints(kind)
    except NameError:  # a type that is imported for type checkers only
        hints = {}
    record = object.__new__(kind)
    for field in fields(kind):
        object.__setattr__(record, field.name, large(hints.get(field.name, tuple)))
    return record


def public_records() -> list[type]:
    modules = (importlib.import_module(f"openvima{name}") for name in PACKAGES)
    found = [getattr(module, name) for module in modules for name in module.__all__]
    kinds = {item for item in found if inspect.isclass(item) and is_dataclass(item)}
    return sorted(kinds, key=str)


@pytest.mark.parametrize("kind", public_records(), ids=lambda kind: kind.__name__)
def test_a_public_record_fits_a_screen(kind: type) -> None:
    if kind is Results:  # whose representation computes means
        outcomes = tuple(EpisodeOutcome(seed, seed % 2 == 0, 2) for seed in range(MANY))
        rows = (
            Row(f"policy {n}", f"task {n}", level, 1, outcomes) for n in range(50) for level in ("L1", "L2")
        )
        record: object = Results(tuple(rows))
    else:
        record = large_record(kind)
    assert kind.__name__ in repr(record)
    assert len(repr(record)) <= MAX_CHARACTERS


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
