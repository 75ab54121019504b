"""Demonstrations with objects of others in view."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.data.object_cache.episode import (  # noqa: E402
    BOXES,
    COUNT,
    ID,
    NUMBERS,
    PICK,
    PLACE,
    SPURIOUS_NUMBERS,
    preprocess,
)
from openvima.data.records import rollout_oracle  # noqa: E402
from openvima.env import TabletopEnv  # noqa: E402
from openvima.errors import ConfigError  # noqa: E402
from openvima.policies.inputs import Reader  # noqa: E402
from openvima.training import TrainingConfig, train  # noqa: E402
from openvima.training.dataset import Example, stack_images  # noqa: E402
from openvima.training.learner import PolicyCollate  # noqa: E402
from openvima.training.source import Parts  # noqa: E402
from openvima.training.strangers import MOST_STRANGERS, receives_strangers, with_strangers  # noqa: E402
from training_examples import rngs_of  # noqa: E402

TASKS = ("rotate", "novel_adj", "novel_noun", "pick_in_order_then_restore", "same_shape", "rearrange")


@pytest.fixture(scope="module")
def episodes():
    def tokens(task: str):
        return preprocess(rollout_oracle(TabletopEnv(task, level="train", domain="user"), 1), "objects")

    return [tokens(task) for task in TASKS]


@pytest.fixture(scope="module")
def stacked(episodes):
    return stack_images(episodes, Reader("objects"))


def _steps(episode) -> list[np.ndarray]:
    return np.split(episode.objects, np.cumsum(episode.steps[:, COUNT])[:-1])


def _overlap(one: np.ndarray, other: np.ndarray) -> bool:
    for v in range(2):
        (x, y, height, width), (x2, y2, height2, width2) = (
            row[BOXES].reshape(2, 4)[v] for row in (one, other)
        )
        seen = one[NUMBERS][v] > 0 and other[NUMBERS][v] > 0
        if seen and 2 * abs(x - x2) < width + width2 and 2 * abs(y - y2) < height + height2:
            return True
    return False


def test_strangers_lie_beside_what_was_there_at_all_steps_and_nothing_else_changes(stacked):
    examples, stack = stacked
    added = 0
    for example in examples[:4]:
        for seed, other in enumerate(examples):
            if other is example:
                continue
            more = with_strangers(example, other, np.random.default_rng(seed)).tokens
            before, source = example.tokens, other.tokens
            first = source.objects[: source.steps[0, COUNT]]
            strangers = None
            for ours, theirs in zip(_steps(before), _steps(more), strict=True):
                assert np.array_equal(theirs[: len(ours), ID], ours[:, ID])
                assert np.array_equal(theirs[: len(ours), BOXES], ours[:, BOXES])
                came = theirs[len(ours) :]
                assert strangers is None or np.array_equal(came, strangers)
                strangers = came
                assert not set(came[:, ID]) & set(before.objects[:, ID])
                assert not any(_overlap(a, b) for a in came for b in ours)
            assert strangers is not None and len(strangers) <= MOST_STRANGERS
            added += len(strangers)
            for row in strangers:
                (origin,) = (k for k in first if np.array_equal(k[NUMBERS] + other.base, row[NUMBERS]))
                assert np.array_equal(origin[BOXES], row[BOXES])
                for number, whole in zip(origin[NUMBERS], row[NUMBERS], strict=True):
                    assert np.array_equal(source.images[number - 1], stack[whole].numpy())
            assert np.array_equal(more.steps[:, [PICK, PLACE]], before.steps[:, [PICK, PLACE]])
            assert np.array_equal(more.actions, before.actions)
            assert more.text == before.text
            for name, columns in (("prompt", NUMBERS), ("final", NUMBERS), ("steps", SPURIOUS_NUMBERS)):
                own, counted = getattr(before, name)[:, columns], getattr(more, name)[:, columns]
                assert np.array_equal(np.where(own > 0, own + example.base, 0), counted)
    assert added > 10


def test_few_tasks_receive_strangers(episodes):
    assert [receives_strangers(episode) for episode in episodes] == [True] * 4 + [False] * 2


def test_strangers_are_drawn_in_training_alone_with_the_share_asked_for(episodes):
    examples = [Example(episode, row=row) for row, episode in enumerate(episodes)]
    collate = PolicyCollate(Reader("objects"), 0.0, with_images=True)

    def counts(share: float) -> torch.Tensor:
        parts = Parts(collate, 0, 99, count=1, strangers=examples, stranger_share=share)
        ((batch, _),) = parts(examples, 4)
        return (batch.history.num_slots_BT * batch.history.steps_BT).sum(dim=1)

    order = np.argsort([episode.num_steps for episode in episodes], kind="stable")
    plain = torch.tensor([episodes[row].steps[:, COUNT].sum() + 2 * episodes[row].num_steps for row in order])
    assert torch.equal(counts(0.0), plain)
    more = counts(1.0) - plain
    receiving = torch.tensor([receives_strangers(episodes[row]) for row in order])
    assert (more[~receiving] == 0).all() and (more >= 0).all() and more.sum() > 0


@pytest.mark.parametrize("with_images", [True, False])
def test_a_batch_shows_the_same_pictures_however_they_are_numbered(with_images, stacked):
    examples, stack = stacked
    borrowing = [replace(e, other=o) for e, o in zip(examples[:4], examples[2:], strict=True)]
    collate = PolicyCollate(Reader("objects"), 0.0, with_images=with_images)
    batch = collate(borrowing, rngs_of(borrowing))
    images = stack if batch.images is None else batch.images
    for b, example in enumerate(borrowing):
        numbers = batch.history.crop_index_BTVN[b, 0]
        shown = {images[n].numpy().tobytes() for n in numbers.flatten().tolist() if n}
        expected = with_strangers(example, example.other, rngs_of(borrowing)[b]).tokens
        rows = expected.objects[: expected.steps[0, COUNT]]
        assert shown == {stack[n].numpy().tobytes() for n in rows[:, NUMBERS].flatten() if n}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "gpt-nano", "stranger_share": 0.5}, "sees whole frames"),
        ({"stranger_share": 1.5}, "stranger_share"),
    ],
)
def test_wrong_shares_say_so(settings, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        train(TrainingConfig(data=tmp_path, out=tmp_path / "run", **settings))
