"""Training on detected boxes: inputs as in inference, the requested fraction, exact resuming."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from openvima.data import Dataset
from openvima.data.object_cache import CACHE_VERSION, open_object_cache
from openvima.detector.plugins import detected_object_cache, plugged_boxes
from openvima.errors import ConfigError
from openvima.training import TrainingConfig, train
from openvima.training.batches import BatchMaker, ExampleSource
from openvima.training.config import LoaderConfig
from openvima.training.source import alternative_source, split_examples
from plugged_extractors import HOOK


@pytest.fixture(scope="module")
def sources(data: Path) -> tuple[ExampleSource, ExampleSource]:
    """Demonstrations with true boxes, and with those of the noisy extractor."""
    dataset = Dataset(data)
    true, _ = split_examples(
        open_object_cache(dataset), LoaderConfig(validation_fraction=0.2, validation_episodes=9)
    )
    first_image = int(true.cache.image_counts().sum())
    return true, alternative_source(detected_object_cache(dataset, plugged_boxes(HOOK)), true, first_image)


def detected_rows(sources, share: float, number: int, rows: slice = slice(None)) -> tuple[list, list]:
    """Which demonstrations of a batch have detected boxes, and the next draw of each generator."""
    true, detected = sources
    first_detected = int(true.cache.image_counts().sum())
    found, draws = [], []

    def collate(part, rngs):
        for example, rng in zip(part, rngs, strict=True):
            draws.append((example.row, rng.random()))
            if example.base >= first_detected:
                found.append(example.row)

    BatchMaker(true, collate, 3, 5, alternatives=((detected, share),))(np.arange(len(true))[rows], number)
    return sorted(found), sorted(draws)


def test_boxes_are_drawn_per_demonstration(sources) -> None:
    true, _ = sources
    rows = true.rows.tolist()
    assert detected_rows(sources, 0.0, 1)[0] == []
    assert detected_rows(sources, 1.0, 1)[0] == rows
    drawn = [detected_rows(sources, 0.5, number)[0] for number in range(40)]
    assert drawn == [detected_rows(sources, 0.5, number)[0] for number in range(40)]
    assert len({tuple(found) for found in drawn}) > 30  # anew in each batch
    share = np.mean([len(found) / len(rows) for found in drawn])
    assert abs(share - 0.5) < 4 * 0.5 / np.sqrt(40 * len(rows))
    (whole, draws), (part, part_draws) = (
        detected_rows(sources, 0.5, 7, rows) for rows in (slice(None), slice(3, 9))
    )
    assert part == [row for row in whole if row in rows[3:9]]  # whoever shares the batch
    assert set(part_draws) <= set(draws)


def test_each_cache_is_drawn_with_its_probability(sources) -> None:
    true, detected = sources
    first_images = [0, int(true.cache.image_counts().sum())]
    first_images.append(first_images[1] + int(detected.cache.image_counts().sum()))
    cache = open_object_cache(true.cache.dataset, appearance=0)
    alternatives = ((detected, 0.5), (alternative_source(cache, true, first_images[2]), 0.3))
    counts = np.zeros(3)

    def collate(part, rngs):
        for example in part:
            counts[np.searchsorted(first_images, example.base, side="right") - 1] += 1

    for number in range(40):
        BatchMaker(true, collate, 3, 5, alternatives=alternatives)(np.arange(len(true)), number)
    np.testing.assert_allclose(counts / counts.sum(), [0.2, 0.5, 0.3], atol=0.08)


def test_demonstrations_that_a_cache_lacks_keep_true_boxes(sources) -> None:
    true, detected = sources
    first_image = int(true.cache.image_counts().sum())
    part = plugged_boxes(HOOK, fraction=0.5)
    part = alternative_source(detected_object_cache(true.cache.dataset, part), true, first_image)
    assert 0 < len(part) < len(true)
    assert detected_rows((true, part), 1.0, 1)[0] == part.rows.tolist()
    some, every = detected_rows((true, part), 0.5, 7), detected_rows((true, detected), 0.5, 7)
    assert some[0] == [row for row in every[0] if row in part.rows]
    assert some[1] == every[1]  # further draws are the same


def test_an_example_names_its_images_in_the_stack_of_both(sources) -> None:
    true, detected = sources
    images = np.concatenate([tokens.images for source in sources for tokens in source.cache])
    for source in sources:
        for row in true.rows.tolist():
            example = source.example(row)
            assert example.row == row
            np.testing.assert_array_equal(
                images[example.base : example.base + len(example.episode.images)], example.episode.images
            )
    assert [e.episode.seed for e in detected] == [e.episode.seed for e in true]


@pytest.mark.slow
def test_true_boxes_alone_need_no_detector_and_detected_ones_no_true_tokens(settings, tmp_path) -> None:
    short = {**settings, "pretraining.steps": 0, "schedule.steps": 2, "object_cache": tmp_path / "tokens"}
    detected = train(TrainingConfig.of({**short, "loader.boxes": HOOK, "loader.detected_prob": 1.0}))
    (folder,) = (tmp_path / "tokens").iterdir()
    assert folder.name == f"objects-v{CACHE_VERSION}-{plugged_boxes(HOOK).name}"
    plain = train(TrainingConfig.of({**short, "out": tmp_path / "plain"}))
    assert len(list((tmp_path / "tokens").iterdir())) == 2
    none = train(
        TrainingConfig.of(
            {**short, "out": tmp_path / "none", "loader.boxes": HOOK, "loader.detected_prob": 0.0}
        )
    )
    mixed = train(TrainingConfig.of({**short, "out": tmp_path / "mixed", "loader.boxes": HOOK}))
    metrics = [(run / "metrics.jsonl").read_text() for run in (plain, none, mixed, detected)]
    assert metrics[0] == metrics[1]
    assert len(set(metrics)) == 3
    written = yaml.safe_load((mixed / "config.yaml").read_text())
    assert written["training"]["loader"]["detected_prob"] == 0.5
    assert written["demonstrations"]["boxes"] == plugged_boxes(HOOK).name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"loader.detected_prob": 0.5}, "loader.detected_prob is 0.5, but no detector is given"),
        (
            {"loader.boxes": HOOK, "loader.detected_prob": 1.0, "loader.detected_fraction": 0.5},
            "loader.detected_fraction is 0.5, but loader.detected_prob 1 leaves no true boxes",
        ),
        ({"loader.boxes": HOOK, "loader.rerendered_prob": 0.6}, "rerendered_prob are 1.1 together"),
        (
            {"loader.boxes": HOOK, "preset": "gato-nano"},
            "preset 'gato-nano' takes whole frames; leave it out",
        ),
        ({"loader.boxes": "nobody"}, "boxes is 'nobody'; give detector"),
    ],
)
def test_invalid_boxes_leave_no_run_folder(settings, change, message) -> None:
    fits = {"pretraining.steps": 0} if "preset" in change else {}
    with pytest.raises(ConfigError, match=message):
        train(TrainingConfig.of({**settings, **fits, **change}))
    assert not settings["out"].exists()
