"""Training of attributes: labels of rendered objects, captions, and the losses."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import PUBLISHED_TASKS
from openvima.catalog.random_pack import RandomAppearanceAssets
from openvima.errors import ConfigError
from openvima.evaluation.prompt_ablations import held_out_phrasings
from openvima.policies.build import build_network
from openvima.policies.pointer.config import ATTRIBUTES, AttributeConfig
from openvima.policies.pointer.words import Attributes
from openvima.policies.tokenizer import PADDING_ID, Vocabulary, WordTokenizer, split_words
from openvima.scene import Placement, Pose
from openvima.scene.prompt import PLACEHOLDER
from openvima.tasks import task_spec
from openvima.tasks.prompts import training_paraphrases
from openvima.training import TrainingConfig
from openvima.training.building import resolve
from openvima.training.config import PretrainingConfig
from openvima.training.pretraining.losses import (
    _compare_attributes,
    _images,
    attribute_accuracy,
    attribute_loss,
)
from openvima.training.pretraining.pairs import (
    AttributeLabels,
    Pairs,
    attributes_of_object,
    render_pairs,
)
from openvima.training.pretraining.stage import (
    WORDS,
    caption_loss,
    caption_texts,
    crop_parameters,
    sample_captions,
)
from openvima.training.recipes import recipe_settings
from small_networks import narrow_small

PROBS = {"appearance_randomization_prob": 0.4, "hard_negative_prob": 0.5, "grayscale_prob": 0.3}
AUGMENTED = PretrainingConfig(num_scenes=12, **PROBS)
TOKENIZER = WordTokenizer(Vocabulary().extended(caption_texts()))


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    return render_pairs(
        ("same_shape", "novel_adj"),
        replace(AUGMENTED, attribute_loss_weight=0.5),
        seed=0,
        assets="procedural",
        second_view=True,
    )


@pytest.fixture(scope="module")
def labeller() -> Callable:
    return partial(attributes_of_object, assets=RandomAppearanceAssets(load_assets("procedural")))


def placement(name: str, texture: str = "red", height: float = 1.0) -> Placement:
    return Placement(5, name, texture, (0.07, 0.07, 0.07), Pose.planar(0.5, 0.0), scale=(1.0, 1.0, height))


def labels_of(labeller: Callable, *placements: Placement) -> AttributeLabels:
    """Labels of objects that look in their prompt image as in their scene."""
    columns = [torch.from_numpy(np.stack(column)) for column in zip(*map(labeller, placements), strict=True)]
    boxes = torch.zeros(len(placements), 3, 2, 4, dtype=torch.int64)
    return AttributeLabels(*(column[:, None].expand(-1, 2, -1) for column in columns), boxes)


@pytest.mark.parametrize(
    ("other", "same", "different"),
    [
        (placement("block"), ATTRIBUTES, ()),
        (placement("block", "dark red"), ("shape", "profile", "height", "size"), ("texture", "colour")),
        # Half of its pixels are red, so that its colour is neither the same nor another one.
        (placement("block", "red and blue stripe"), ("shape", "profile", "height", "size"), ("texture",)),
        (placement("block", height=2.0), ("texture", "colour", "shape", "profile", "size"), ("height",)),
        (placement("frame"), ("texture", "colour", "profile"), ("shape", "height", "size")),
        (placement("heart"), ("texture", "colour", "size"), ("shape", "profile", "height")),
    ],
)
def test_a_block_is_compared_by_each_attribute(labeller, other, same, different):
    images = _images(labels_of(labeller, placement("block"), other), (0,))
    is_same, is_different = (
        {name for name, flag in zip(ATTRIBUTES, flags[:, 0, 1].tolist(), strict=True) if flag}
        for flags in _compare_attributes(images, images)
    )
    assert is_same == set(same)
    assert is_different >= set(different)
    assert not is_same & is_different


def test_random_containers_are_round_square_or_neither(labeller):
    known = {name: int(labeller(placement(name))[0][2]) for name in ("bowl", "frame")}
    found = [int(labeller(placement(f"random container {seed}"))[0][2]) for seed in range(40)]
    assert {found.count(index) > 4 for index in known.values()} == {True}
    assert set(found) - set(known.values())
    assert int(labeller(placement("random shape 3"))[0][2]) not in known.values()
    eared = [int(labeller(placement(f"random eared container {seed}"))[0][2]) for seed in range(40)]
    assert [index if index in known.values() else None for index in eared] == [
        index if index in known.values() else None for index in found
    ]


def test_magnified_objects_have_no_lengths(labeller):
    assert np.isnan(labeller(placement("block"), is_magnified=True)[2]).all()
    np.testing.assert_allclose(labeller(placement("block"))[2], [0.07, 0.089], atol=5e-4)


def test_pairs_are_labelled_as_rendered(pairs):
    labels = pairs.attributes
    assert labels is not None
    # Grayscale prompt images have another texture than their scene, and only they.
    is_same = labels.categories[:, 0] == labels.categories[:, 1]
    assert is_same[:, 1:].all()
    assert torch.equal(is_same[:, 0], ~pairs.is_grayscale)
    assert torch.equal(labels.boxes.any(dim=-1), pairs.masks)
    np.testing.assert_allclose(labels.colours.sum(dim=-1), 1.0, rtol=1e-5)
    plain = render_pairs(
        ("same_shape", "novel_adj"),
        replace(AUGMENTED, num_scenes=2),
        seed=0,
        assets="procedural",
        second_view=True,
    )
    assert plain.attributes is None
    assert torch.equal(plain.crops[:, 1], pairs.crops[: len(plain.scenes), 1])


class Ideal(torch.nn.Module):
    """Projections that are given."""

    def __init__(self, projected_3KPW: torch.Tensor) -> None:
        super().__init__()
        self.projected_3KPW = projected_3KPW

    def forward(self, *_: torch.Tensor) -> torch.Tensor:
        return self.projected_3KPW


def test_the_loss_falls_as_what_is_alike_is_projected_together(labeller):
    objects = [placement("block"), placement("frame"), placement("heart", "blue"), placement("ring", "blue")]
    labels, masks = labels_of(labeller, *objects), torch.ones(3, 2, 4, dtype=torch.bool)

    def loss(by_texture: list[int]) -> float:
        axes = torch.eye(4)[torch.tensor(by_texture)]  # of every attribute
        projected = axes[None, :, None].expand(3, -1, len(ATTRIBUTES), -1).clone()
        projected[:, :, 1:] = torch.eye(4)[0]  # the others learn nothing here
        features = torch.zeros(3, 2, 4, 1)
        return float(attribute_loss(Ideal(projected), features, masks, labels))

    assert loss([0, 0, 1, 1]) < loss([0, 1, 2, 3]) < loss([0, 1, 0, 1])
    right = loss([0, 0, 1, 1])
    masks[:, :, 3] = False  # what is not seen does not count
    assert loss([0, 0, 1, 0]) == pytest.approx(right, abs=0.3)


def test_a_few_steps_fit_the_attributes(pairs):
    network = build_network(replace(narrow_small(), attributes=AttributeConfig(32, 16)), seed=0)
    encoder, attributes = network.images, network.attributes
    assert isinstance(attributes, Attributes)
    crops, masks = pairs.crops.transpose(0, 1), pairs.masks.permute(1, 2, 0)
    with torch.no_grad():
        features = encoder.encode_images(crops).transpose(1, 2)
    before = attribute_accuracy(encoder, attributes, pairs)
    optimizer = torch.optim.Adam(attributes.projections.parameters(), 1e-3)
    for _ in range(15):
        optimizer.zero_grad()
        attribute_loss(attributes, features, masks, pairs.attributes).backward()
        optimizer.step()
    after = attribute_accuracy(encoder, attributes, pairs)
    # Those without a prompt image that has both are left out; these scenes have few of a profile.
    assert len(after) > 3 and after.keys() == before.keys() <= set(ATTRIBUTES)
    assert np.mean(list(after.values())) > np.mean(list(before.values())) + 0.05
    assert {*map(id, attributes.parameters())} <= {*map(id, crop_parameters(network))}  # later frozen


def test_captions_teach_every_word():
    attributes = Attributes(AttributeConfig(4, 4), narrow_small().images, TOKENIZER.vocabulary.num_ids)
    captions, unseen = (sample_captions(500, TOKENIZER.encode, np.random.default_rng(k)) for k in range(2))
    optimizer = torch.optim.Adam(attributes.words.parameters(), 2e-3)
    for _ in range(100):
        optimizer.zero_grad()
        caption_loss(attributes, captions).backward()
        optimizer.step()
    named = attributes.word_logits(unseen.word_ids) > 0
    named &= (unseen.word_ids != PADDING_ID)[..., None]
    assert torch.equal(named.any(dim=1), unseen.targets)


def test_only_prompts_that_compare_by_attributes_name_them():
    words = {word for names in WORDS.values() for word in names}
    texts = {task: [task_spec(task).template] for task in PUBLISHED_TASKS}
    for phrasings in (training_paraphrases(), held_out_phrasings()):
        for task, more in phrasings.items():
            texts[task] += more
    named = {
        task for task, of in texts.items() if words & set(split_words(PLACEHOLDER.sub("", " ".join(of))))
    }
    assert named == {"same_shape", "same_texture"}


def test_the_weight_needs_attributes_and_these_the_preset_small(tmp_path):
    settings = {"data": tmp_path, "out": tmp_path / "run", "preset": "small"}
    with pytest.raises(ConfigError, match=r"set model\.attributes, or"):
        wanted = {"model.attributes": False, "pretraining.attribute_loss_weight": 1}
        resolve(TrainingConfig.of({**settings, **wanted}))
    with pytest.raises(ConfigError, match=r"set model\.attributes to False"):
        resolve(TrainingConfig.of({**settings, "pretraining.attribute_loss_weight": 0}))
    with pytest.raises(ConfigError, match="preset small"):
        resolve(TrainingConfig.of({**settings, "preset": "nano", "model.attributes": True}))
    resolve(TrainingConfig.of({**recipe_settings("small"), "data": tmp_path, "out": tmp_path / "run"}))
