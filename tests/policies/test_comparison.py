"""Comparisons: what is compared with what, what is told of it, and what makes no difference."""

from dataclasses import fields, replace

import pytest

torch = pytest.importorskip("torch")

from openvima.policies.nn.comparison import (  # noqa: E402
    Comparison,
    ComparisonConfig,
    Sights,
    alike_shown,
    earlier,
    others,
)

from openvima.errors import ConfigError  # noqa: E402
from openvima.policies import preset  # noqa: E402
from openvima.policies.nn.conv_encoder import ConvConfig  # noqa: E402
from openvima.policies.nn.object_encoder import ObjectEncoder, ObjectEncoderConfig  # noqa: E402

B, N, M, V, F, A, D = 2, 3, 4, 2, 6, 5, 8
IMAGES = ObjectEncoderConfig(
    ConvConfig(4, F), box_width=4, width=D, fuse_views=True, appearance_width=A, turn_bins=8
)


def inputs(count: int, seed: int, **known) -> Sights:
    generator = torch.Generator().manual_seed(seed)

    def drawn(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    values = {
        "features_VNF": drawn(B, V, count, F),
        "boxes_VN4": torch.randint(10, 100, (B, V, count, 4), generator=generator),
        "masks_VN": torch.ones(B, V, count, dtype=torch.bool),
        "appearance_NA": torch.nn.functional.normalize(drawn(B, count, A), dim=-1),
        "positions_N2": drawn(B, count, 2) * 0.1,
        "on_table_N": torch.ones(B, count, dtype=torch.bool),
        "numbers_N": torch.zeros(B, count, dtype=torch.int64),
    }
    return Sights(**{**values, **known})


def placed(some: Sights, order) -> Sights:
    """The same objects in another order."""
    axes = {"features_VNF": -2, "boxes_VN4": -2, "positions_N2": -2, "appearance_NA": -2}
    values = {
        field.name: getattr(some, field.name).index_select(axes.get(field.name, -1), order)
        for field in fields(some)
    }
    return Sights(**values)


@pytest.fixture
def encoder() -> ObjectEncoder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return ObjectEncoder(IMAGES).double().eval()


@pytest.fixture
def comparison() -> Comparison:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return Comparison(ComparisonConfig(hidden_width=16), IMAGES).double().eval()


ANY = torch.ones(N, M, dtype=torch.bool)


def weights(comparison: Comparison, own: Sights, other: Sights, allowed=ANY) -> "torch.Tensor":
    """What looks are at, (B, H, N, M)."""
    kept = []
    original = comparison._weights
    comparison._weights = lambda *values: kept.append(original(*values)) or kept[-1]
    comparison(own, other, allowed, lambda *_: torch.zeros(B, allowed.shape[-2], 8, dtype=torch.float64))
    del comparison._weights
    return kept[0]


def test_each_object_is_compared_with_the_one_that_looks_like_it(comparison):
    other = inputs(M, seed=1)
    own = inputs(N, seed=2, appearance_NA=other.appearance_NA[:, [2, 0, 3]])
    looks = weights(comparison, own, other)
    assert (looks.argmax(-1) == torch.tensor([2, 0, 3])).all()
    assert (looks.amax(-1) > 0.9).all()


def test_what_looks_like_nothing_there_is_compared_with_nothing(comparison):
    other = inputs(M, seed=1, appearance_NA=torch.eye(A, dtype=torch.float64)[:M].expand(B, M, A))
    lonely = torch.eye(A, dtype=torch.float64)[M:].expand(B, N, A)
    assert weights(comparison, inputs(N, seed=2, appearance_NA=lonely), other).sum(-1).max() < 0.01


def test_of_pictures_that_look_alike_one_look_takes_the_latest_and_one_the_earliest(comparison):
    same = torch.nn.functional.normalize(torch.ones(B, 4, A, dtype=torch.float64), dim=-1)
    frames = inputs(4, seed=1, appearance_NA=same, numbers_N=torch.arange(4).expand(B, 4))
    looks = weights(comparison, frames, frames, earlier(frames))
    assert (looks[:, 0, 3].argmax(-1) == 2).all()
    assert (looks[:, 1, 3].argmax(-1) == 0).all()
    assert (looks[:, :, 0] == 0).all()  # nothing is earlier than the first image
    assert (looks.diagonal(dim1=-2, dim2=-1) == 0).all()


def test_others_are_all_but_the_object_itself():
    assert torch.equal(others(inputs(3, seed=0)), ~torch.eye(3, dtype=torch.bool))


def test_what_lies_on_the_table_is_shown_alike_and_so_is_what_is_shown_alone():
    on_table = torch.tensor([[False, True, True]]).expand(B, -1)
    alike = alike_shown(inputs(3, seed=0, on_table_N=on_table))
    assert alike[0].tolist() == [[True, False, False], [False, True, True], [False, True, True]]


def test_the_way_that_an_object_has_gone_is_told_and_nothing_else_if_all_else_is_equal(comparison):
    before = inputs(N, seed=1)
    way = torch.tensor([0.05, -0.02], dtype=torch.float64)
    after = replace(before, positions_N2=before.positions_N2 + way)
    told = []
    comparison.difference.register_forward_pre_hook(lambda _, arguments: told.append(arguments[0]))
    match = torch.eye(N, dtype=torch.bool)
    comparison(after, before, match, lambda *_: torch.zeros(B, N, 8, dtype=torch.float64))
    looks = told[0][..., :-8].unflatten(-1, (2, -1))
    found, likeness, lying, near, along, across = looks[..., :6].unbind(-1)
    assert (found > 0.999).all()
    torch.testing.assert_close(likeness, found)
    torch.testing.assert_close(lying, found)
    assert ((near > 0.01) & (near < 0.1)).all()
    torch.testing.assert_close(along, found * 0.5)
    torch.testing.assert_close(across, found * -0.2)
    torch.testing.assert_close(looks[..., 6:], torch.zeros_like(looks[..., 6:]), atol=1e-9, rtol=0)


def test_places_of_what_is_shown_alone_say_nothing(comparison, encoder):
    other = inputs(M, seed=1, on_table_N=torch.zeros(B, M, dtype=torch.bool))
    own = inputs(N, seed=2, appearance_NA=other.appearance_NA[:, :N])
    moved = replace(other, positions_N2=other.positions_N2 + 0.3)
    turns = encoder.turn_between
    assert torch.equal(comparison(own, other, ANY, turns)[0], comparison(own, moved, ANY, turns)[0])


def test_neither_order_nor_what_does_not_exist_matters(comparison, encoder):
    masks = torch.ones(B, V, M, dtype=torch.bool)
    masks[:, :, 3] = False
    other = inputs(M, seed=1, masks_VN=masks)
    own = inputs(N, seed=2, appearance_NA=other.appearance_NA[:, [3, 1, 0]])
    told, turns = comparison(own, other, ANY, encoder.turn_between)
    order, own_order = torch.tensor([1, 3, 0, 2]), torch.tensor([2, 0, 1])
    mixed, mixed_turns = comparison(placed(own, own_order), placed(other, order), ANY, encoder.turn_between)
    torch.testing.assert_close(mixed, told[:, own_order])
    torch.testing.assert_close(mixed_turns, turns[:, own_order])
    features = other.features_VNF.clone()
    features[:, :, 3] = 9.0
    changed = replace(other, features_VNF=features)
    assert torch.equal(comparison(own, changed, ANY, encoder.turn_between)[0], told)
    fewer = placed(other, torch.arange(3))
    torch.testing.assert_close(comparison(own, fewer, ANY[:, :3], encoder.turn_between)[0], told)


def test_there_may_be_nothing_to_compare_with(comparison, encoder):
    own, none = inputs(N, seed=1), inputs(0, seed=2)
    told, turns = comparison(own, none, ANY[:, :0], encoder.turn_between)
    assert told.shape == (B, N, D)
    assert told.isfinite().all()
    assert not turns.any()


def test_turns_are_those_from_what_is_looked_at(comparison, encoder):
    """The features of pictures come back from the look as they are, if it is at one of them alone."""
    before = inputs(N, seed=1)
    after = replace(inputs(N, seed=2), appearance_NA=before.appearance_NA)
    _, turns = comparison(after, before, torch.eye(N, dtype=torch.bool), encoder.turn_between)
    asked = encoder.turn_between(before.features_VNF, after.features_VNF, before.masks_VN, after.masks_VN)
    torch.testing.assert_close(turns, asked, atol=1e-6, rtol=1e-4)


def test_in_training_some_crops_are_left_out(encoder):
    images = replace(IMAGES, crop_dropout=0.5)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        module = Comparison(ComparisonConfig(hidden_width=16), images).double()
        before = inputs(N, seed=1)
        own = inputs(N, seed=2, appearance_NA=before.appearance_NA)
        seen = []
        module.difference.register_forward_pre_hook(lambda _, arguments: seen.append(arguments[0]))
        match = torch.eye(N, dtype=torch.bool)
        for _ in range(20):
            module(own, before, match, encoder.turn_between)
    front = torch.stack(seen)[..., 6 : 6 + F]
    left_out = (front == 0).all(-1).double().mean()
    assert 0.3 < left_out < 0.7


@pytest.mark.parametrize("sizes", [{"hidden_width": 0}, {"num_looks": 0}])
def test_sizes_that_make_no_sense_are_refused(sizes):
    with pytest.raises(ConfigError, match="comparison"):
        ComparisonConfig(**sizes)


@pytest.mark.parametrize("part", ["copying head", "comparison"])
def test_what_a_policy_needs_to_copy_and_to_compare_is_named(part):
    sizes = preset("small")
    without = replace(sizes.images, appearance_width=0, turn_bins=0)
    kept = {"comparison": None} if part == "copying head" else {"head": preset("nano-bins").head}
    with pytest.raises(ConfigError, match=rf"{part} needs objects with fuse_views.* appearance width"):
        replace(sizes, images=without, **kept)
