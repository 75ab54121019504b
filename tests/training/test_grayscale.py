"""Grayscale prompt images, which match by shape alone; random containers that only texture distinguishes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.catalog.packs import load_assets
from openvima.catalog.random_pack import RandomAppearanceAssets, is_random
from openvima.perception.objects import observe_prompt_image
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Placement, Pose, Prompt, Scene
from openvima.tasks.novel_words import gray_image
from openvima.training.augmentation.scenes import with_random_appearance
from openvima.training.config import PretrainingConfig
from openvima.training.pretraining import losses
from openvima.training.pretraining.losses import TEMPERATURE, find_matches, info_nce, retrieval_accuracy
from openvima.training.pretraining.pairs import (
    Pairs,
    pairs_of_scene,
    stack_rows,
)

SIZE = (0.144, 0.144, 0.036)  # m
RED_A = Placement(5, "letter A", "red", SIZE, Pose.planar(0.5, -0.2))
BLUE_A = replace(RED_A, id=6, texture="blue", pose=Pose.planar(0.5, 0.0))
HIGH_HEART = Placement(7, "heart", "red", SIZE, Pose.planar(0.5, 0.2), scale=(1.0, 1.0, 2.0))


@pytest.fixture(scope="module")
def rasteriser() -> Rasteriser:
    return Rasteriser(load_assets("procedural"))


def pairs_of(rasteriser: Rasteriser, *placements: Placement, gray_slots=()) -> Pairs:
    """Pairs with a second view of the same scene."""
    scene, unturned = Scene(placements), {placement.id: 0.0 for placement in placements}
    rows = pairs_of_scene(scene, {}, rasteriser, 0, (scene, unturned), gray_slots=gray_slots)
    return stack_rows(rows)


def test_a_grayscale_prompt_image_is_that_of_the_tasks_whatever_texture_and_scale(rasteriser):
    low = replace(HIGH_HEART, id=8, texture="green", scale=(1.0, 1.0, 1.0), pose=Pose.planar(0.6, -0.1))
    pairs = pairs_of(rasteriser, BLUE_A, HIGH_HEART, low, gray_slots=[1, 2])
    assert pairs.is_grayscale.tolist() == [False, True, True] and pairs.masks[:, 0].all()
    image = rasteriser.prompt(Prompt("{object}", (("object", gray_image(HIGH_HEART)),))).images["object"]
    for crops in pairs.crops[1:, 0]:
        np.testing.assert_array_equal(crops, observe_prompt_image(image).crops[:, 0])
    plain = pairs_of(rasteriser, BLUE_A, HIGH_HEART, low)
    assert not plain.is_grayscale.any()
    assert torch.equal(plain.crops[:, 1], pairs.crops[:, 1])
    assert torch.equal(plain.crops[0, 0], pairs.crops[0, 0])
    same_texture = pairs_of(rasteriser, HIGH_HEART, replace(low, texture="red"))
    assert not torch.equal(same_texture.crops[0, 0], same_texture.crops[1, 0])  # scale shows


def test_a_grayscale_row_matches_its_shape_and_others_their_appearance(rasteriser):
    purple_a = replace(RED_A, id=8, texture="purple", pose=Pose.planar(0.6, 0.3))
    red_a = replace(RED_A, id=9, pose=Pose.planar(0.4, 0.3))
    low_heart = replace(HIGH_HEART, id=10, scale=(1.0, 1.0, 1.0), pose=Pose.planar(0.6, -0.3))
    placements = (RED_A, BLUE_A, HIGH_HEART, purple_a, red_a, low_heart)
    gray = pairs_of(rasteriser, *placements, gray_slots=[0, 2])
    assert find_matches(gray).int().tolist() == [
        [1, 1, 0, 1, 1, 0],  # a grayscale A
        [0, 1, 0, 0, 0, 0],
        [0, 0, 1, 0, 0, 1],  # a grayscale heart
        [0, 0, 0, 1, 0, 0],
        [1, 0, 0, 0, 1, 0],
        [0, 0, 0, 0, 0, 1],  # objects of other height are other appearances
    ]


def test_matches_are_no_negatives_of_the_loss_and_the_accuracy():
    own, other = torch.tensor([1.0, 0.0]), torch.tensor([0.8, 0.6])
    first, second = torch.stack([other, other]), torch.stack([own, other])  # both are more like the second
    is_match = torch.eye(2, dtype=torch.bool)
    strict_loss, strict = info_nce(first, second, is_match)
    is_match[0, 1] = True
    loss, accuracy = info_nce(first, second, is_match)
    assert (strict, accuracy) == (0.5, 1.0)
    assert loss < strict_loss
    scores = first @ second.T / TEMPERATURE
    # What is left: the second row against the first object, and that object against the second row.
    apart = torch.stack([scores[1, 0] - scores[1, 1], scores[1, 0] - scores[0, 0]])
    torch.testing.assert_close(loss, apart.exp().log1p().sum() / 4)


def test_a_grayscale_prompt_image_retrieves_any_object_of_its_shape(monkeypatch):
    """Objects 0 and 1 have one shape; `found` is the object that each prompt image retrieves."""
    found = torch.tensor([1, 0, 0])
    crops = torch.zeros(2, 3, 2, 3, 32, 32, dtype=torch.uint8)
    crops[0, :, 0, 0, 0, 0], crops[1, :, 0, 0, 0, 0] = found, torch.arange(3)
    seen = torch.ones(3, 2, dtype=torch.bool)
    is_grayscale = torch.tensor([True, False, True])
    pairs = Pairs(
        crops.transpose(0, 1),
        seen[:, None].expand(-1, 2, -1),
        torch.arange(3),
        torch.zeros(3, dtype=torch.int64),
        torch.tensor([7, 7, 8]),
        is_grayscale,
    )

    def embedded(encoder, crops, masks):
        return torch.nn.functional.one_hot(crops[:, 0, 0, 0, 0].long(), 3).float()

    monkeypatch.setattr(losses, "embed", embedded)
    assert retrieval_accuracy(None, pairs) == pytest.approx(1 / 3)  # the first; the last is no shape of 8
    assert retrieval_accuracy(None, replace(pairs, is_grayscale=~is_grayscale)) == pytest.approx(1 / 3)
    assert retrieval_accuracy(None, replace(pairs, is_grayscale=torch.zeros_like(is_grayscale))) == 0


def containers_of(seed: int, prob: float = 1.0) -> list[str]:
    """Shapes of three bowls, a frame and two hearts with random appearance."""
    names = ("bowl", "bowl", "bowl", "frame", "heart", "heart")
    scene = Scene(
        tuple(
            Placement(5 + k, name, "red", (0.15, 0.15, 0.05), Pose.planar(0.5, 0.1 * k - 0.3), fixed=k < 4)
            for k, name in enumerate(names)
        )
    )
    changed = with_random_appearance(
        scene,
        prob,
        RandomAppearanceAssets(load_assets("procedural")),
        np.random.default_rng(seed),
        PretrainingConfig(),
    )
    return [placement.object for placement in changed.placements]


def test_random_containers_of_one_kind_are_alike_in_half_of_the_scenes():
    scenes = [containers_of(seed) for seed in range(60)]
    assert all(is_random(name) for scene in scenes for name in scene)
    counts = [len(set(scene[:3])) for scene in scenes]
    assert set(counts) == {1, 3}
    assert 0.25 < counts.count(1) / len(counts) < 0.75
    # What was not alike does not become so, and what can be moved has a shape of its own.
    assert all(scene[3] not in scene[:3] and scene[4] != scene[5] for scene in scenes)
    assert len({scene[0] for scene in scenes}) == len(scenes)
