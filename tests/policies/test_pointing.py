"""The pointing head: what it points at, where it places, what its loss counts."""

import math
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from openvima.policies.heads.pointing import (  # noqa: E402
    PointingConfig,
    PointingHead,
    at,
    carried_place,
    turn_of,
    yaw_bin,
)

from openvima.errors import ConfigError  # noqa: E402
from openvima.policies.nn.actions import ACTION_PARTS, ActionTargets, HeadInputs  # noqa: E402
from openvima.scene import Action  # noqa: E402

B, T, N, M, D, A = 3, 2, 4, 3, 8, 5


@pytest.fixture
def head() -> PointingHead:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = PointingHead(PointingConfig(hidden_width=16), D).double()
        torch.nn.init.normal_(network.offset.weight, std=0.1)  # it starts at zero
        return network


@pytest.fixture
def inputs() -> HeadInputs:
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    low, size = torch.tensor([0.25, -0.5]), torch.tensor([0.5, 1.0])
    positions = low + size * torch.rand(B, T, N, 2, generator=generator).double()
    masks = torch.ones(B, T, N, dtype=torch.bool)
    masks[1, :, 3] = False
    prompt_masks = torch.ones(B, M, dtype=torch.bool)
    prompt_masks[2, 1:] = False
    return HeadInputs(
        query_BTD=drawn(B, T, D),
        objects_BTND=drawn(B, T, N, D),
        masks_BTN=masks,
        appearance_BTNA=torch.nn.functional.normalize(drawn(B, T, N, A), dim=-1),
        positions_BTN2=positions,
        grasps_BTN2=positions + 0.001,
        lifts_BT=torch.tensor([[True, True], [False, False], [True, False]]),
        prompt_BMD=drawn(B, M, D),
        prompt_masks_BM=prompt_masks,
        prompt_appearance_BMA=torch.nn.functional.normalize(drawn(B, M, A), dim=-1),
    )


def targets(inputs: HeadInputs, *, yaw: float = 0.0) -> ActionTargets:
    """Pick slot 0, place exactly on slot 1."""
    actions = torch.zeros(B, T, 12, dtype=torch.float64)
    actions[..., 0:2], actions[..., 6:8] = inputs.grasps_BTN2[:, :, 0], inputs.positions_BTN2[:, :, 1]
    actions[..., 5], actions[..., 10], actions[..., 11] = 1, math.sin(yaw / 2), math.cos(yaw / 2)
    slots = torch.zeros(B, T, dtype=torch.int64)
    return ActionTargets(actions, slots, slots + 1, torch.ones(B, T, dtype=torch.bool))


def test_it_picks_at_the_grasp_point_and_places_by_the_position(head, inputs):
    pick = head.pick(inputs).argmax(-1)
    place = head.place_scores(inputs, pick).argmax(-1)
    offset, yaw = head.relate(inputs, pick, place)
    decided = head.decide(inputs)
    torch.testing.assert_close(decided[..., 0:2], at(inputs.grasps_BTN2, pick))
    expected = at(inputs.positions_BTN2, place) + offset
    low, high = torch.tensor([0.25, -0.5]).double(), torch.tensor([0.75, 0.5]).double()
    torch.testing.assert_close(decided[..., 6:8], expected.clamp(low, high))
    torch.testing.assert_close(turn_of(decided) % (2 * math.pi), yaw.argmax(-1).double() * (2 * math.pi / 72))


def test_what_does_not_exist_is_never_pointed_at(head, inputs):
    masks = torch.zeros_like(inputs.masks_BTN)
    masks[..., 2] = True
    only_one = replace(inputs, masks_BTN=masks)
    decided = head.decide(only_one)
    torch.testing.assert_close(decided[..., 0:2], inputs.grasps_BTN2[:, :, 2])


def test_values_behind_the_masks_change_nothing(head, inputs):
    hidden, absent = ~inputs.masks_BTN[..., None], ~inputs.prompt_masks_BM[..., None]
    changed = replace(
        inputs,
        objects_BTND=inputs.objects_BTND.masked_fill(hidden, 9.0),
        appearance_BTNA=inputs.appearance_BTNA.masked_fill(hidden, 9.0),
        positions_BTN2=inputs.positions_BTN2.masked_fill(hidden, 9.0),
        grasps_BTN2=inputs.grasps_BTN2.masked_fill(hidden, 9.0),
        prompt_BMD=inputs.prompt_BMD.masked_fill(absent, 9.0),
        prompt_appearance_BMA=inputs.prompt_appearance_BMA.masked_fill(absent, 9.0),
    )
    assert torch.equal(head.decide(changed), head.decide(inputs))
    assert torch.equal(
        head.loss(changed, targets(inputs))[0],
        head.loss(inputs, targets(inputs))[0],
    )


def test_the_order_of_objects_does_not_change_the_action(head, inputs):
    order = torch.tensor([2, 0, 3, 1])
    shuffled = replace(
        inputs,
        objects_BTND=inputs.objects_BTND[:, :, order],
        masks_BTN=inputs.masks_BTN[:, :, order],
        appearance_BTNA=inputs.appearance_BTNA[:, :, order],
        positions_BTN2=inputs.positions_BTN2[:, :, order],
        grasps_BTN2=inputs.grasps_BTN2[:, :, order],
    )
    torch.testing.assert_close(head.decide(shuffled), head.decide(inputs))


def test_what_looks_like_the_prompt_object_is_picked_where_looks_are_all_that_count(head, inputs):
    for layer in (head.pick.query, head.pick.key):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    looks = inputs.prompt_appearance_BMA[:, :1].expand(B, M, A)  # all images of a prompt show the same
    for slot in range(3):
        appearance = inputs.appearance_BTNA.clone()
        appearance[:, :, slot] = looks[:, :1]
        scores = head.pick(replace(inputs, appearance_BTNA=appearance, prompt_appearance_BMA=looks))
        assert (scores.argmax(-1) == slot).all()


def test_a_prompt_without_objects_is_possible(head, inputs):
    none = replace(
        inputs,
        prompt_BMD=inputs.prompt_BMD[:, :0],
        prompt_masks_BM=inputs.prompt_masks_BM[:, :0],
        prompt_appearance_BMA=inputs.prompt_appearance_BMA[:, :0],
    )
    assert head.decide(none).isfinite().all()
    blank = replace(inputs, prompt_masks_BM=torch.zeros_like(inputs.prompt_masks_BM))
    assert head.decide(blank).isfinite().all()


def test_places_far_outside_are_brought_back_into_bounds(head, inputs):
    torch.nn.init.constant_(head.offset.bias, 100.0)
    for vector in head.decide(inputs).detach().flatten(0, 1).float().numpy():
        Action.from_arrays({key: vector[part] for key, part in ACTION_PARTS.items()})


def test_the_loss_falls_to_nothing_and_the_metrics_to_one_when_everything_is_right(head, inputs):
    wanted = targets(inputs, yaw=math.radians(30))
    optimizer = torch.optim.Adam([*head.parameters()], lr=0.03)
    first, _ = head.loss(inputs, wanted)
    for _ in range(150):
        optimizer.zero_grad()
        loss, metrics = head.loss(inputs, wanted)
        loss.backward()
        optimizer.step()
    assert loss < 0.1 < first
    assert all(metrics[name] == 1 for name in metrics if name.endswith("accuracy"))
    decided = head.decide(inputs)
    torch.testing.assert_close(decided[..., 0:2], wanted.actions_BTC[..., 0:2])
    torch.testing.assert_close(decided[..., 6:8], wanted.actions_BTC[..., 6:8], atol=0.01, rtol=0)
    torch.testing.assert_close(decided[..., 8:], wanted.actions_BTC[..., 8:])


@pytest.mark.parametrize("unknown", ["steps_BT", "pick_BT", "place_BT"])
def test_steps_without_a_target_have_no_loss(head, inputs, unknown):
    wanted = targets(inputs)
    value = getattr(wanted, unknown).clone()
    value[0, 0] = False if unknown == "steps_BT" else -1
    partial = replace(wanted, **{unknown: value})
    loss, metrics = head.loss(inputs, partial)
    actions = partial.actions_BTC.clone()
    actions[0, 0, 6:8] += 0.2
    changed, changed_metrics = head.loss(inputs, replace(partial, actions_BTC=actions))
    assert changed == loss
    assert changed_metrics == metrics
    assert loss != head.loss(inputs, wanted)[0]


def test_a_batch_without_any_target_has_no_loss_and_no_bad_gradient(head, inputs):
    none = torch.full((B, T), -1)
    loss, _ = head.loss(inputs, replace(targets(inputs), pick_BT=none, place_BT=none))
    loss.backward()
    assert loss == 0
    assert all(p.grad is None or p.grad.isfinite().all() for p in head.parameters())


@pytest.mark.parametrize("degrees", range(-180, 181, 30))
def test_turns_of_actions_are_read_back(degrees):
    arrays = Action.planar((0.5, 0), (0.5, 0), math.radians(degrees)).to_arrays()
    action = torch.cat([torch.from_numpy(arrays[key]) for key in ACTION_PARTS])[None, None]
    assert yaw_bin(turn_of(action), 72).item() == degrees // 5 % 72


def test_an_object_held_elsewhere_still_goes_where_it_was_demonstrated():
    yaw = math.radians(120)
    arrays = Action.planar((0.4, 0.1), (0.6, -0.2), yaw).to_arrays()
    action = torch.cat([torch.from_numpy(arrays[key]) for key in ACTION_PARTS]).double()[None, None]
    grasp = torch.tensor([[[0.43, 0.08]]], dtype=torch.float64)
    corner = torch.tensor([0.45, 0.13], dtype=torch.float64)  # of the object
    turn = torch.tensor(
        [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]], dtype=torch.float64
    )
    demonstrated = action[0, 0, 6:8] + turn @ (corner - action[0, 0, :2])
    own = carried_place(action, grasp)[0, 0] + turn @ (corner - grasp[0, 0])
    torch.testing.assert_close(own, demonstrated, atol=1e-6, rtol=0)


def test_only_what_is_lifted_is_carried(head, inputs):
    wanted = targets(inputs)
    actions = wanted.actions_BTC.clone()
    actions[..., 0:2] += 0.01  # held elsewhere
    held = replace(wanted, actions_BTC=actions)
    for lifts, carried in ((True, True), (False, False)):
        now = replace(inputs, lifts_BT=torch.full((B, T), lifts))
        assert (head.loss(now, held)[0] != head.loss(now, wanted)[0]).item() == carried


@pytest.mark.parametrize("sizes", [{"num_yaw_bins": 1}, {"hidden_width": 0}])
def test_sizes_that_make_no_sense_are_refused(sizes):
    with pytest.raises(ConfigError, match="pointing head"):
        PointingConfig(**sizes)
