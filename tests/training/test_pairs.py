"""Pairs of contrastive pretraining: where they come from, augmentation, and rotations between their views."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import pool
from openvima.catalog.random_pack import RandomAppearanceAssets, is_random
from openvima.policies.nn.image_encoders import ConvConfig
from openvima.policies.nn.object_encoder import ObjectEncoder, ObjectEncoderConfig, RelativeRotation
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Placement, Pose, Scene
from openvima.tasks import sample_episode
from openvima.training.augmentation.scenes import (
    rearrange,
    with_hard_negatives,
    with_random_appearance,
)
from openvima.training.config import PretrainingConfig
from openvima.training.loop import step_generator
from openvima.training.parallel import Parallel
from openvima.training.pretraining.losses import (
    draw_channel_mixing,
    is_rotation_correct,
    rotation_loss,
)
from openvima.training.pretraining.pairs import (
    Pairs,
    pairs_of_scene,
    render_pairs,
    stack_rows,
)
from openvima.training.pretraining.stage import with_horizontal_flips, with_occlusion

TASKS = ("twist", "novel_adj", "visual_manipulation")
PLAIN = PretrainingConfig()
LABELLED = PretrainingConfig(attribute_loss_weight=0.5)
HARD = PretrainingConfig(appearance_randomization_prob=0.5, hard_negative_prob=0.6)


def rendered(num_scenes: int, *, seed=0, tasks=TASKS, augmentation=PLAIN, **options) -> Pairs:
    config = replace(augmentation, num_scenes=num_scenes)
    return render_pairs(tasks, config, seed=seed, assets="procedural", **options)


def test_pairs_follow_from_the_seed():
    first, second, other = (rendered(4, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first.crops[:, 1], second.crops[:, 1])
    assert first.crops[:, 1].shape != other.crops[:, 1].shape or not torch.equal(
        first.crops[:, 1], other.crops[:, 1]
    )


@pytest.mark.slow
def test_workers_change_nothing(monkeypatch):
    monkeypatch.setattr("openvima.training.pretraining.pairs._CHUNK", 3)
    options = {"augmentation": HARD, "second_view": True}
    one, three = (rendered(7, **options, workers=workers) for workers in (1, 3))
    for name in ("crops", "appearances", "scenes", "is_grayscale"):
        assert torch.equal(getattr(one, name), getattr(three, name)), name


def test_processes_share_the_scenes(monkeypatch):
    """Gathering their rows is tested in `test_parallel.py`."""
    monkeypatch.setattr(Parallel, "rows_of_all", lambda self, rows: rows)
    one, *parts = (
        rendered(
            5,
            augmentation=LABELLED,
            second_view=True,
            parallel=Parallel(rank, count, torch.device("cpu")),
        )
        for rank, count in ((0, 1), (0, 2), (1, 2))
    )
    assert one.scenes.unique().tolist() == list(range(5))
    for name in ("crops", "appearances", "scenes", "shapes"):
        assert torch.equal(getattr(one, name), torch.cat([getattr(part, name) for part in parts]))
    categories = [part.attributes.categories for part in (one, *parts)]
    assert torch.equal(categories[0], torch.cat(categories[1:]))


def test_channel_mixing_keeps_grey():
    generator = step_generator(0, "colours", 0)
    mixings = torch.stack([draw_channel_mixing(generator) for _ in range(50)])
    torch.testing.assert_close(mixings.sum(dim=2), torch.ones(50, 3))
    assert (mixings >= 0).all()
    unchanged = (mixings == torch.eye(3)).all(dim=2).all(dim=1).float().mean()
    assert 0.3 < unchanged < 0.8


def test_random_containers_are_gratings_as_often_as_asked():
    assets = RandomAppearanceAssets(load_assets("procedural"))
    scene = sample_episode("visual_manipulation", level="train", seed=0, domain="user").problem.scene
    containers = {
        prob: {
            placement.object.rpartition(" ")[0]
            for seed in range(20)
            for placement in with_random_appearance(
                scene, 1.0, assets, np.random.default_rng(seed), PretrainingConfig(grating_prob=prob)
            ).placements
            if placement.object.startswith(("random container", "random grating"))
        }
        for prob in (0.0, 0.5, 1.0)
    }
    assert containers[0.0] == {"random container"}
    assert containers[0.5] == {"random container", "random grating"}
    assert containers[1.0] == {"random grating"}


@pytest.fixture(scope="module")
def pairs():
    return rendered(12, augmentation=HARD, second_view=True)


def test_bars_have_the_colour_of_the_background_and_the_rest_stays(pairs):
    occluded = with_occlusion(pairs, 1.0, step_generator(0, "gaps", 0))
    for before, after, background in (
        (pairs.crops[:, 0], occluded.crops[:, 0], 255),
        (pairs.crops[:, 1], occluded.crops[:, 1], 51),
        (pairs.crops[:, 2], occluded.crops[:, 2], 51),
    ):
        changed = after != before
        assert (after[changed] == background).all()
        fraction = (after == background).all(2).float().mean((1, 2, 3))
        assert (fraction > 0.05).all()
        assert changed.float().mean() < 0.6
        border = torch.stack([changed[..., [0, -1], :].any(), changed[..., :, [0, -1]].any()])
        assert not border.any()


def test_some_objects_are_occluded_in_all_of_their_images(pairs):
    occluded = with_occlusion(pairs, 0.4, step_generator(0, "gaps", 1))
    touched = [
        (after != before).flatten(1).any(1)
        for before, after in (
            (pairs.crops[:, 0], occluded.crops[:, 0]),
            (pairs.crops[:, 1], occluded.crops[:, 1]),
        )
    ]
    is_occluded = touched[0] | touched[1]
    assert 0.2 < is_occluded.float().mean() < 0.6
    assert occluded.rotations[is_occluded].isnan().all()
    assert torch.equal(
        occluded.rotations[~is_occluded].nan_to_num(),
        pairs.rotations[~is_occluded].nan_to_num(),
    )


def test_probability_zero_changes_nothing_and_equal_seeds_occlude_equally(pairs):
    none = with_occlusion(pairs, 0.0, step_generator(0, "gaps", 0))
    assert torch.equal(none.crops[:, 0], pairs.crops[:, 0].float())
    assert torch.equal(none.rotations.nan_to_num(), pairs.rotations.nan_to_num())
    same = [with_occlusion(pairs, 0.5, step_generator(0, "gaps", 2)).crops[:, 1] for _ in range(2)]
    assert torch.equal(*same)


@pytest.fixture
def encoder() -> ObjectEncoder:
    torch.manual_seed(0)
    crop = ConvConfig(8, 16, place_channels=2)
    sizes = {"box_width": 4, "width": 8, "appearance_width": 16, "rotation_bins": 72}
    return ObjectEncoder(ObjectEncoderConfig(crop, fuse_views=True, **sizes))


@pytest.mark.parametrize("augmentation", [PretrainingConfig(), HARD])
def test_nothing_comes_from_the_test_levels(augmentation, monkeypatch):
    """Pairs show training objects in textures of their role, and random ones where it is asked for."""
    shown = []
    original = Rasteriser.prompt

    def spy(self, prompt):
        shown.append(prompt.images[0][1].placement)
        return original(self, prompt)

    monkeypatch.setattr(Rasteriser, "prompt", spy)
    tasks = (*TASKS, "rotate", "sweep_without_exceeding")
    pairs = rendered(30, seed=3, tasks=tasks, augmentation=augmentation, second_view=augmentation is HARD)
    pools = [pool(task, "train") for task in tasks]
    objects = {name for entry in pools for name in (*entry.dragged_objects, *entry.base_objects)}
    objects |= {name for entry in pools for name in getattr(entry, "constraint_objects", ())} | {"line"}
    textures = {
        (name, fixed)
        for entry in pools
        for fixed, names in ((False, entry.dragged_textures), (True, entry.base_textures))
        for name in names
    }
    assert len(pairs.appearances) <= len(shown)
    assert {p.object for p in shown if not is_random(p.object)} <= objects
    assert {(p.texture, p.fixed) for p in shown if not is_random(p.texture)} <= textures
    fraction = sum(is_random(p.texture) for p in shown) / len(shown)
    assert 0.2 < fraction < 0.8 if augmentation is HARD else fraction == 0


def test_a_second_view_leaves_the_scenes_unchanged():
    plain, twice = rendered(4), rendered(4, second_view=True)
    assert plain.rotations is None
    assert torch.equal(plain.crops, twice.crops[:, :2])


def test_hard_negatives_differ_in_one_respect():
    assets = RandomAppearanceAssets(load_assets("procedural"))
    rng = np.random.default_rng(0)
    originals = tuple(
        Placement(5 + k, name, texture, (0.144, 0.144, 0.036), Pose.planar(0.4 + 0.1 * k, 0.2 * k, z=0.0))
        for k, (name, texture) in enumerate((("letter A", "red"), ("heart", "green")))
    )
    kinds = set()
    for _ in range(40):
        scene = with_hard_negatives(Scene(originals), 1.0, {"red", "dark red", "green"}, assets, rng)
        for negative in scene.placements[2:]:
            differing = min(
                (
                    [
                        name
                        for name in ("object", "texture", "scale")
                        if getattr(negative, name) != getattr(p, name)
                    ]
                    for p in originals
                ),
                key=len,
            )
            assert len(differing) <= 1
            kinds |= {*differing, negative.texture}
    assert {"object", "scale", "dark red"} <= kinds or {"scale", "texture", "dark red"} <= kinds
    assert "dark green" not in kinds


def test_rotations_are_those_between_the_headings():
    rng = np.random.default_rng(1)
    hearts = (Placement(k, "heart", "red", (0, 0, 0), Pose.planar(0.5, 0.1 * k, k)) for k in (1, 2))
    scene = Scene(tuple(hearts))
    again, rotations = rearrange(scene, rng)
    for before, after in zip(scene.placements, again.placements, strict=True):
        error = after.pose.yaw_rad - before.pose.yaw_rad - rotations[before.id]
        assert abs(math.remainder(error, 2 * math.pi)) < 1e-9


def test_without_rotation_prompt_image_and_scene_have_the_same_crop():
    scene = Scene((Placement(5, "letter A", "red", (0, 0, 0), Pose.planar(0.5, 0.0, math.pi / 2)),))
    rasteriser = Rasteriser(load_assets("procedural"))
    rows = pairs_of_scene(scene, {}, rasteriser, 0, (scene, {5: 0.0}))
    drawn = stack_rows(rows)
    assert drawn.rotations.tolist() == [[0.0, 0.0]]
    red = (drawn.crops[0, 0, 1, 0] == 255) & (drawn.crops[0, 0, 1, 1] == 87)
    also_red = (drawn.crops[0, 1, 1, 0] == 255) & (drawn.crops[0, 1, 1, 1] == 87)
    assert (red == also_red).float().mean() > 0.95


def test_rotations_from_prompt_images_follow_from_the_heading():
    scene = Scene((Placement(5, "letter A", "red", (0, 0, 0), Pose.planar(0.5, 0.0, 2.0)),))
    rows = pairs_of_scene(scene, {}, Rasteriser(load_assets("procedural")), 0, (scene, {5: 0.5}))
    np.testing.assert_allclose(stack_rows(rows).rotations[0], [2.0 - math.pi / 2, 0.5], rtol=1e-6)


@pytest.mark.parametrize("yaw", [0.4, 1.9])
def test_a_mirrored_image_is_that_of_a_mirrored_heading(yaw):
    """The T is its own mirror image about its upright, which at yaw 0 points to the left of the robot."""
    rasteriser = Rasteriser(load_assets("procedural"))
    crops = []
    for heading in (yaw, -yaw - math.pi):
        scene = Scene((Placement(5, "letter T", "red", (0, 0, 0), Pose.planar(0.5, 0.0, heading)),))
        rows = pairs_of_scene(scene, {}, rasteriser, 0)
        crops.append(stack_rows(rows).crops[0, 1, :, 0].float())
    difference = (crops[0].flip(-1) - crops[1]).abs()
    assert difference.mean() < 0.35 * (crops[0] - crops[1]).abs().mean()


def test_horizontal_flips_reverse_rotations(pairs):
    mirrored = with_horizontal_flips(pairs, step_generator(0, "mirror", 0))
    is_mirrored = (mirrored.crops[:, 1] == pairs.crops[:, 1].flip(-1)).flatten(1).all(1)
    shows = ~pairs.rotations[:, 0].isnan()
    assert 0.2 < is_mirrored.float().mean() < 0.8
    expected = torch.where(is_mirrored[:, None], -pairs.rotations, pairs.rotations)
    assert torch.equal(mirrored.rotations[shows], expected[shows])
    crops = pairs.crops[:, 2]
    flipped = torch.where(is_mirrored[:, None, None, None, None], crops.flip(-1), crops)
    assert torch.equal(mirrored.crops[:, 2], flipped)


def test_rotations_are_correct_within_fifteen_degrees(encoder):
    class Fixed(torch.nn.Module):
        """Always estimates 25 degrees."""

        def forward(self, first, second, seen, seen_again):
            return torch.log_softmax(50.0 * torch.eye(72)[[5] * seen.shape[-1]], dim=-1)

    encoder.rotation = Fixed()
    features, seen = torch.zeros(3, 2, 4, 1), torch.ones(3, 2, 4, dtype=torch.bool)
    rotations = torch.deg2rad(torch.tensor([25.0, 39.0, 41.0, 25.0 - 360.0]))[:, None].expand(4, 2)
    right = is_rotation_correct(encoder, features, seen, rotations)
    assert right.tolist() == [True, True, False, True]
    exact = torch.deg2rad(torch.tensor([[25.0, 360.0], [25.0, -360.0]]))
    assert rotation_loss(encoder, features[:, :, :2], seen[:, :, :2], exact) > 10  # the second is wrong
    seen[1] = False
    assert rotation_loss(encoder, features[:, :, :2], seen[:, :, :2], exact) < 1e-3


FRONT, TOP = 0, 1
VISIBLE = torch.ones(2, 3, dtype=torch.bool)


def _features(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, 2, 3, 16, generator=torch.Generator().manual_seed(len(shape)))


def test_exchanging_the_images_inverts_the_rotation(encoder):
    first, second = _features(), _features(1)[0]
    there = encoder.rotation_between(first, second, VISIBLE, VISIBLE)
    back = encoder.rotation_between(second, first, VISIBLE, VISIBLE)
    torch.testing.assert_close(there, back.flip(-1).roll(1, -1))


def test_equal_crops_are_not_rotated(encoder):
    probabilities = encoder.rotation_between(_features(), _features(), VISIBLE, VISIBLE)
    assert (probabilities.argmax(-1) == 0).all()


def test_the_top_view_decides_where_it_shows_both(encoder):
    first, second = _features(), _features(1)[0]
    probabilities = encoder.rotation_between(first, second, VISIBLE, VISIBLE)
    torch.testing.assert_close(probabilities.sum(-1), torch.ones(3))
    other_front = first.clone()
    other_front[FRONT] += 1.0
    assert torch.equal(probabilities, encoder.rotation_between(other_front, second, VISIBLE, VISIBLE))

    hidden = VISIBLE.clone()
    hidden[TOP, 1] = False
    of_front = encoder.rotation_between(first, second, hidden, VISIBLE)
    assert torch.equal(of_front[[0, 2]], probabilities[[0, 2]])
    assert not torch.equal(of_front[1], probabilities[1])


def test_without_a_common_view_the_distribution_is_uniform(encoder):
    only_top, only_front = VISIBLE.clone(), VISIBLE.clone()
    only_top[FRONT], only_front[TOP] = False, False
    probabilities = encoder.rotation_between(_features(), _features(1)[0], only_top, only_front)
    torch.testing.assert_close(probabilities, torch.full((3, 72), 1 / 72))


def test_shifted_phases_are_a_rotation():
    estimator = RelativeRotation(features=256, bins=72)
    with torch.no_grad():
        for view in estimator.views:  # features are the harmonics themselves
            view.weight.copy_(torch.eye(256))
            view.bias.zero_()
    angle = 2 * math.pi * 17 / 72
    harmonics = torch.randn(16, 8, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))
    rotated = harmonics * torch.exp(1j * angle * torch.arange(1, 9))
    first, second = (
        torch.stack([w.real, w.imag]).flatten().expand(2, 1, 256).contiguous() for w in (harmonics, rotated)
    )
    visible = torch.ones(2, 1, dtype=torch.bool)
    assert int(estimator(first, second, visible, visible).argmax()) == 17
