"""The object head: what it points at, where it places, what its loss counts."""

import math
from dataclasses import replace

import pytest
import torch

from openvima.policies.nn.actions import ACTION_PARTS, ActionTargets, at, carry, yaw_between
from openvima.policies.pointer.config import ObjectHeadConfig
from openvima.policies.pointer.inputs import HeadInputs
from openvima.policies.pointer.object_head import ObjectPointerHead
from openvima.scene import Action
from small_networks import IN_VIEW, drawn_head_inputs, in_order, with_prompt

B, T, N, M, D, A = 3, 2, 4, 3, 8, 5


@pytest.fixture
def head() -> ObjectPointerHead:
    torch.manual_seed(0)
    network = ObjectPointerHead(ObjectHeadConfig(hidden_width=16), D).double()
    torch.nn.init.normal_(network.offset.weight, std=0.1)  # it starts at zero
    return network


@pytest.fixture
def inputs() -> HeadInputs:
    """Some objects of the second episode, and of the third one's prompt, do not exist."""
    exist = torch.ones(B, M, dtype=torch.bool)
    exist[2, 1:] = False
    return with_prompt(drawn_head_inputs((B, T, N, M, D, A), first=0, scene=0), object_mask_BL=exist)


def targets(inputs: HeadInputs, *, yaw: float = 0.0) -> ActionTargets:
    """Pick slot 0, place exactly on slot 1."""
    actions = torch.zeros(B, T, 12, dtype=torch.float64)
    actions[..., 0:2], actions[..., 6:8] = inputs.grasps_BTN2[:, :, 0], inputs.positions_BTN2[:, :, 1]
    actions[..., 5], actions[..., 10], actions[..., 11] = 1, math.sin(yaw / 2), math.cos(yaw / 2)
    slots = torch.zeros(B, T, dtype=torch.int64)
    return ActionTargets(actions, slots, slots + 1, torch.ones(B, T, dtype=torch.bool))


def test_it_picks_at_the_grasp_point_and_places_by_the_position(head, inputs):
    pick = head.pick(inputs).argmax(-1)
    place = head.place_logits(inputs, pick).argmax(-1)
    offset, yaw = head.relate(inputs, pick, place)
    decided = head.decode(inputs)
    torch.testing.assert_close(decided[..., 0:2], at(inputs.grasps_BTN2, pick))
    expected = at(inputs.positions_BTN2, place) + offset
    low, high = torch.tensor([0.25, -0.5]).double(), torch.tensor([0.75, 0.5]).double()
    torch.testing.assert_close(decided[..., 6:8], expected.clamp(low, high))
    torch.testing.assert_close(
        yaw_between(decided) % (2 * math.pi), yaw.argmax(-1).double() * (2 * math.pi / 72)
    )


def test_what_does_not_exist_is_never_pointed_at(head, inputs):
    masks = torch.zeros_like(inputs.masks_BTN)
    masks[..., 2] = True
    only_one = replace(inputs, masks_BTN=masks)
    decided = head.decode(only_one)
    torch.testing.assert_close(decided[..., 0:2], inputs.grasps_BTN2[:, :, 2])


def test_values_behind_the_masks_change_nothing(head, inputs):
    hidden, absent = ~inputs.masks_BTN[..., None], ~inputs.prompt.object_mask_BL[..., None]
    changed = with_prompt(
        inputs,
        masked_BLD=inputs.prompt.masked_BLD.masked_fill(absent, 9.0),
        appearance_BLA=inputs.prompt.appearance_BLA.masked_fill(absent, 9.0),
    )
    values = {name: getattr(inputs, name).masked_fill(hidden, 9.0) for name in IN_VIEW}
    changed = replace(changed, **values)
    assert torch.equal(head.decode(changed), head.decode(inputs))
    wanted = targets(inputs)
    assert torch.equal(head.loss(changed, wanted)[0], head.loss(inputs, wanted)[0])


def test_the_order_of_objects_does_not_change_the_action(head, inputs):
    shuffled = in_order(inputs, torch.tensor([2, 0, 3, 1]))
    torch.testing.assert_close(head.decode(shuffled), head.decode(inputs))


def test_the_object_similar_to_the_prompt_object_is_picked_where_only_appearance_counts(head, inputs):
    for layer in (head.pick.query, head.pick.key):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    same = inputs.prompt.appearance_BLA[:, :1].expand(B, M, A)  # all images of a prompt show the same
    for slot in range(3):
        appearance = inputs.appearance_BTNA.clone()
        appearance[:, :, slot] = same[:, :1]
        known = with_prompt(replace(inputs, appearance_BTNA=appearance), appearance_BLA=same)
        scores = head.pick(known)
        assert (scores.argmax(-1) == slot).all()


def test_a_prompt_without_objects_is_possible(head, inputs):
    blank = with_prompt(inputs, object_mask_BL=torch.zeros_like(inputs.prompt.object_mask_BL))
    assert head.decode(blank).isfinite().all()


def test_places_far_outside_are_brought_back_into_bounds(head, inputs):
    torch.nn.init.constant_(head.offset.bias, 100.0)
    for vector in head.decode(inputs).detach().flatten(0, 1).float().numpy():
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
    decided = head.decode(inputs)
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


def test_an_object_held_elsewhere_still_goes_where_it_was_demonstrated():
    yaw = math.radians(120)
    arrays = Action.planar((0.4, 0.1), (0.6, -0.2), yaw).to_arrays()
    action = torch.cat([torch.from_numpy(arrays[key]) for key in ACTION_PARTS]).double()[None, None]
    grasp = torch.tensor([[[0.43, 0.08]]], dtype=torch.float64)
    corner = torch.tensor([0.45, 0.13], dtype=torch.float64)  # of the object
    rotation = torch.tensor(
        [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]], dtype=torch.float64
    )
    demonstrated = action[0, 0, 6:8] + rotation @ (corner - action[0, 0, :2])
    own = carry(action, grasp)[0, 0] + rotation @ (corner - grasp[0, 0])
    torch.testing.assert_close(own, demonstrated, atol=1e-6, rtol=0)


def test_only_what_is_lifted_is_carried(head, inputs):
    wanted = targets(inputs)
    actions = wanted.actions_BTC.clone()
    actions[..., 0:2] += 0.01  # held elsewhere
    held = replace(wanted, actions_BTC=actions)
    for has_suction, carried in ((True, True), (False, False)):
        now = replace(inputs, has_suction_BT=torch.full((B, T), has_suction))
        assert (head.loss(now, held)[0] != head.loss(now, wanted)[0]).item() == carried
