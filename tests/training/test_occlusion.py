"""Gaps that are painted over crops before looks are matched."""

import pytest

torch = pytest.importorskip("torch")

from openvima.training.augmentation.occlusion import with_gaps  # noqa: E402
from openvima.training.pretrain import PLAIN, Variety, render_pairs  # noqa: E402
from openvima.training.schedule import step_generator  # noqa: E402


@pytest.fixture(scope="module")
def pairs():
    variety = Variety(twins=0.3, again=True)
    return render_pairs(("visual_manipulation",), num_scenes=16, seed=0, assets="procedural", variety=variety)


def test_the_ground_shows_through_gaps_and_the_rest_stays(pairs):
    gaps = with_gaps(pairs, 1.0, step_generator(0, "gaps", 0))
    for before, after, ground in (
        (pairs.prompt_crops, gaps.prompt_crops, 255),
        (pairs.scene_crops, gaps.scene_crops, 51),
        (pairs.again.crops, gaps.again.crops, 51),
    ):
        changed = after != before
        assert (after[changed] == ground).all()
        share = (after == ground).all(2).float().mean((1, 2, 3))
        assert (share > 0.05).all()
        assert changed.float().mean() < 0.6
        border = torch.stack([changed[..., [0, -1], :].any(), changed[..., :, [0, -1]].any()])
        assert not border.any()


def test_gaps_come_to_some_objects_and_then_in_all_of_their_images(pairs):
    gaps = with_gaps(pairs, 0.4, step_generator(0, "gaps", 1))
    touched = [
        (after != before).flatten(1).any(1)
        for before, after in ((pairs.prompt_crops, gaps.prompt_crops), (pairs.scene_crops, gaps.scene_crops))
    ]
    has_gaps = touched[0] | touched[1]
    assert 0.2 < has_gaps.float().mean() < 0.6
    assert gaps.again.turns[has_gaps].isnan().all()
    assert torch.equal(gaps.again.turns[~has_gaps].nan_to_num(), pairs.again.turns[~has_gaps].nan_to_num())


def test_a_share_of_zero_changes_nothing_and_a_seed_draws_the_same_gaps(pairs):
    none = with_gaps(pairs, 0.0, step_generator(0, "gaps", 0))
    assert torch.equal(none.prompt_crops, pairs.prompt_crops.float())
    assert torch.equal(none.again.turns.nan_to_num(), pairs.again.turns.nan_to_num())
    same = [with_gaps(pairs, 0.5, step_generator(0, "gaps", 2)).scene_crops for _ in range(2)]
    assert torch.equal(*same)


def test_scenes_that_are_laid_once_get_gaps_as_well():
    once = render_pairs(("visual_manipulation",), num_scenes=2, seed=0, assets="procedural", variety=PLAIN)
    gaps = with_gaps(once, 1.0, step_generator(0, "gaps", 0))
    assert gaps.again is None
    assert not torch.equal(gaps.scene_crops, once.scene_crops.float())
