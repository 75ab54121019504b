"""Demonstrations that are too long for a network are named before training."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.data import Dataset  # noqa: E402
from openvima.data.object_cache import open_object_cache  # noqa: E402
from openvima.errors import DatasetError  # noqa: E402
from openvima.policies import preset  # noqa: E402
from openvima.policies.build import build_network  # noqa: E402
from openvima.policies.nn import decoder  # noqa: E402
from openvima.policies.processor import Processor  # noqa: E402
from openvima.training import TrainingConfig, source, train  # noqa: E402
from openvima.training.augmentation.prompts import with_motion_prompt  # noqa: E402

NAMES = ("nano", "midas-nano", "gato-nano")  # objects, views, frames


@pytest.fixture(scope="module", params=NAMES)
def case(request, data):
    """A cache, a network and its processor."""
    sizes = preset(request.param)
    processor = Processor.of(sizes.inputs)
    return open_object_cache(Dataset(data), processor.input_kind), build_network(sizes, seed=0), processor


def num_places(tokens, processor) -> int:
    return processor.batch_prompts([tokens.prompt]).word_ids_BL.shape[1]


def test_widths_are_those_of_the_episodes(case) -> None:
    cache, _, _ = case
    expected = [
        (
            max(tokens.prompt.objects_per_image, default=0),
            max(*tokens.objects_per_step, len(tokens.final)),
        )
        for tokens in cache
    ]
    np.testing.assert_array_equal(cache.widths(), expected)


@pytest.mark.parametrize("is_motion", [False, True])
def test_the_bounds_hold(case, is_motion) -> None:
    cache, _, processor = case
    prompt, whole = source._upper_bounds(cache, processor, is_motion)
    episodes = [with_motion_prompt(tokens) if is_motion else tokens for tokens in cache]
    found = np.array([num_places(tokens, processor) for tokens in episodes])
    assert (found <= prompt).all() and (prompt < whole).all()
    assert prompt.max() <= 2 * found.max()  # or else too many would be read


def test_an_inverse_dynamics_prompt_that_is_too_long_is_named(case, monkeypatch) -> None:
    cache, network, processor = case
    tasks, motions = ([num_places(f(t), processor) for t in cache] for f in (lambda t: t, with_motion_prompt))
    limit = max(motions) - 1
    for module in (source, decoder):
        monkeypatch.setattr(module, "MAX_PROMPT_POSITIONS", limit)
    with pytest.raises(
        DatasetError, match=r"^episode \d+ of \w+ with its inverse-dynamics prompt is too long"
    ):
        source.check_lengths(cache, network, processor, inverse_dynamics_prob=1.0)
    if max(tasks) <= limit:
        source.check_lengths(cache, network, processor)
        with pytest.raises(DatasetError, match="with its inverse-dynamics prompt"):
            source.check_lengths(cache, network, processor, inverse_dynamics_prob=0.5)


def test_a_history_that_is_too_long_is_named_before_the_first_step(settings, monkeypatch) -> None:
    for module in (source, decoder):
        monkeypatch.setattr(module, "MAX_POSITIONS", 30)
    config = TrainingConfig.of(
        {**settings, "preset": "midas-nano", "pretraining.steps": 0, "schedule.checkpoint_every": 1}
    )
    with pytest.raises(DatasetError, match=r"of sweep_without_exceeding is too long .* takes 30\. .*--tasks"):
        train(config)
    assert not list(config.out.glob("checkpoints/*"))


@pytest.mark.slow
def test_the_check_draws_no_random_numbers(case, monkeypatch) -> None:
    cache, network, processor = case
    monkeypatch.setattr(source, "MAX_PROMPT_POSITIONS", 1)  # so that all are read
    before = torch.get_rng_state()
    source.check_lengths(cache, network.train(), processor, inverse_dynamics_prob=0.5)
    assert torch.equal(torch.get_rng_state(), before)
    assert all(parameter.grad is None for parameter in network.parameters())
