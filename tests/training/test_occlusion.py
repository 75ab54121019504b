"""Occlusion of the crops of contrastive pretraining."""

import pytest
import torch

from openvima.training.augmentation.crops import with_occlusion
from openvima.training.loop import step_generator
from openvima.training.pretraining.pairs import SceneAugmentation, render_pairs


@pytest.fixture(scope="module")
def pairs():
    augmentation = SceneAugmentation(hard_negative_prob=0.3, second_view=True)
    return render_pairs(
        ("visual_manipulation",), num_scenes=16, seed=0, assets="procedural", augmentation=augmentation
    )


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
