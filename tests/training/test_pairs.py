"""Pairs of contrastive pretraining: where they come from, channel mixing, and the loss."""

import numpy as np
import pytest
import torch

from openvima.catalog.packs import load_assets
from openvima.catalog.random_pack import RandomAppearanceAssets
from openvima.tasks import sample_episode
from openvima.training.augmentation.crops import draw_channel_mixing, with_occlusion
from openvima.training.augmentation.scenes import ShapeKinds, with_random_appearance
from openvima.training.loop import step_generator
from openvima.training.parallel import Parallel
from openvima.training.pretraining import pairs as pairs_module
from openvima.training.pretraining.pairs import Pairs, SceneAugmentation, render_pairs

TASKS = ("rotate", "sweep_without_exceeding", "visual_manipulation")


def rendered(num_scenes: int, *, seed: int = 0, tasks: tuple[str, ...] = TASKS, **options) -> Pairs:
    return render_pairs(tasks, num_scenes=num_scenes, seed=seed, assets="procedural", **options)


def test_pairs_follow_from_the_seed():
    first, second, other = (rendered(4, seed=seed) for seed in (0, 0, 1))
    assert torch.equal(first.scene_crops, second.scene_crops)
    assert first.scene_crops.shape != other.scene_crops.shape or not torch.equal(
        first.scene_crops, other.scene_crops
    )


@pytest.mark.slow
def test_workers_change_nothing(monkeypatch):
    monkeypatch.setattr(pairs_module, "_CHUNK", 3)
    augmentation = SceneAugmentation(second_view=True, hard_negative_prob=0.5)
    one, three = (rendered(7, augmentation=augmentation, workers=workers) for workers in (1, 3))
    for name in ("prompt_crops", "scene_crops", "appearances", "scenes", "is_grayscale"):
        assert torch.equal(getattr(one, name), getattr(three, name)), name
    assert torch.equal(one.second_view.crops, three.second_view.crops)


def test_processes_share_the_scenes(monkeypatch):
    """Gathering their rows is tested in `test_parallel.py`."""
    monkeypatch.setattr(Parallel, "rows_of_all", lambda self, rows: rows)
    one, *parts = (
        rendered(
            5,
            augmentation=SceneAugmentation(second_view=True),
            with_attributes=True,
            parallel=Parallel(rank, count, torch.device("cpu")),
        )
        for rank, count in ((0, 1), (0, 2), (1, 2))
    )
    assert one.scenes.unique().tolist() == list(range(5))
    for name in ("scene_crops", "appearances", "scenes", "shapes"):
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
                scene, 1.0, assets, np.random.default_rng(seed), ShapeKinds(prob)
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
    augmentation = SceneAugmentation(hard_negative_prob=0.3, second_view=True)
    return rendered(16, tasks=("visual_manipulation",), augmentation=augmentation)


def test_bars_have_the_colour_of_the_background_and_the_rest_stays(pairs):
    occluded = with_occlusion(pairs, 1.0, step_generator(0, "gaps", 0))
    for before, after, background in (
        (pairs.prompt_crops, occluded.prompt_crops, 255),
        (pairs.scene_crops, occluded.scene_crops, 51),
        (pairs.second_view.crops, occluded.second_view.crops, 51),
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
            (pairs.prompt_crops, occluded.prompt_crops),
            (pairs.scene_crops, occluded.scene_crops),
        )
    ]
    is_occluded = touched[0] | touched[1]
    assert 0.2 < is_occluded.float().mean() < 0.6
    assert occluded.second_view.rotations[is_occluded].isnan().all()
    assert torch.equal(
        occluded.second_view.rotations[~is_occluded].nan_to_num(),
        pairs.second_view.rotations[~is_occluded].nan_to_num(),
    )


def test_probability_zero_changes_nothing_and_equal_seeds_occlude_equally(pairs):
    none = with_occlusion(pairs, 0.0, step_generator(0, "gaps", 0))
    assert torch.equal(none.prompt_crops, pairs.prompt_crops.float())
    assert torch.equal(none.second_view.rotations.nan_to_num(), pairs.second_view.rotations.nan_to_num())
    same = [with_occlusion(pairs, 0.5, step_generator(0, "gaps", 2)).scene_crops for _ in range(2)]
    assert torch.equal(*same)
