"""The candidate head: which places it may choose, what it learns to copy, where it places what it holds."""

import math
from dataclasses import replace

import pytest
import torch

from openvima.policies.nn.actions import ActionTargets, rotate, yaw_between
from openvima.policies.pointer.candidate_head import CandidatePointerHead
from openvima.policies.pointer.candidates import PlaceCandidates
from openvima.policies.pointer.config import CandidateHeadConfig
from openvima.policies.pointer.inputs import HeadInputs, ObjectSet
from small_networks import drawn_head_inputs, in_order, with_prompt

B, T, N, M, D, A = 3, 2, 4, 3, 8, 5
NUM_FIRST, NUM_SCENE = 3, 2
NUM_ALL = N + NUM_FIRST + NUM_SCENE
IN_VIEW, FIRST_STEP, IN_PROMPT = 0, N, N + NUM_FIRST  # number of the first candidate of each kind


@pytest.fixture
def head() -> CandidatePointerHead:
    torch.manual_seed(0)
    network = CandidatePointerHead(CandidateHeadConfig(hidden_width=16), D).double()
    torch.nn.init.normal_(network.offset.weight, std=0.1)  # it starts at zero
    return network


@pytest.fixture
def inputs() -> HeadInputs:
    """Three episodes; some objects of the second one do not exist."""
    whole = drawn_head_inputs((B, T, N, M, D, A), first=NUM_FIRST, scene=NUM_SCENE)
    return with_objects(whole, "prompt", "masks_BK", [[1, 1], [0, 1], [1, 1]])


def set_of(inputs: HeadInputs, kind: str) -> ObjectSet:
    return inputs.first_step if kind == "first_step" else inputs.prompt.objects


def with_objects(inputs: HeadInputs, kind: str, name: str, value) -> HeadInputs:
    """The same with other objects of the first step or of the prompt."""
    old = set_of(inputs, kind)
    new = replace(old, **{name: torch.as_tensor(value, dtype=getattr(old, name).dtype)})
    return replace(inputs, first_step=new) if kind == "first_step" else with_prompt(inputs, objects=new)


def candidates_of(inputs: HeadInputs) -> PlaceCandidates:
    """All candidates but grid points."""
    grid = ObjectSet(*(getattr(inputs.first_step, name)[:, :0] for name in ObjectSet.__slots__))
    return PlaceCandidates(inputs, grid)


def targets_at(inputs: HeadInputs, place_BT2, *, yaw: float = 0.0, place_slot: int = -1) -> ActionTargets:
    """Pick slot 0 a centimetre beside the grasp point, and bring its centre to a place."""
    held = inputs.grasps_BTN2[:, :, 0] + 0.01 - inputs.positions_BTN2[:, :, 0]
    actions = torch.zeros(B, T, 12, dtype=torch.float64)
    actions[..., 0:2] = inputs.positions_BTN2[:, :, 0] + held
    tool = place_BT2 + rotate(held, torch.full((B, T), yaw, dtype=torch.float64))
    actions[..., 6:8] = torch.where(inputs.has_suction_BT[..., None], tool, place_BT2)
    actions[..., 5], actions[..., 10], actions[..., 11] = 1, math.sin(yaw / 2), math.cos(yaw / 2)
    slots = torch.zeros(B, T, dtype=torch.int64)
    return ActionTargets(actions, slots, slots + place_slot, torch.ones(B, T, dtype=torch.bool))


def place_of(inputs: HeadInputs, candidate: int) -> "torch.Tensor":
    return candidates_of(inputs).positions_BTC2[:, :, candidate]


def test_candidates_are_in_view_then_of_the_first_step_then_of_the_prompt(inputs):
    positions = candidates_of(inputs).positions_BTC2
    assert torch.equal(positions[:, :, :N], inputs.positions_BTN2)
    assert torch.equal(positions[:, 1, FIRST_STEP:IN_PROMPT], inputs.first_step.positions_BK2)
    assert torch.equal(positions[:, 1, IN_PROMPT:], inputs.prompt.objects.positions_BK2)
    assert candidates_of(inputs).masks_BTC[1, 0].tolist() == [True] * 3 + [False] + [True] * 3 + [False, True]


@pytest.mark.parametrize("candidate", [IN_VIEW + 1, FIRST_STEP + 2, IN_PROMPT + 1])
@pytest.mark.parametrize("yaw", [0.0, math.radians(60)])
def test_the_centre_goes_to_the_candidate_whatever_grasp_and_rotation(head, inputs, candidate, yaw):
    only = torch.full((B, T), candidate)
    head.pick.forward = lambda inputs: torch.eye(N)[torch.zeros(B, T, dtype=torch.int64)]
    head.place.forward = lambda inputs, candidates, pick: torch.eye(NUM_ALL)[only].double()
    torch.nn.init.zeros_(head.offset.weight)
    torch.nn.init.constant_(head.yaw.bias, -50.0)
    with torch.no_grad():
        head.yaw.bias[round(math.degrees(yaw) / 5)] = 50.0
    decided = head.decode(inputs)
    torch.testing.assert_close(decided[..., 0:2], inputs.grasps_BTN2[:, :, 0])
    angle = yaw_between(decided)
    torch.testing.assert_close(angle, torch.full_like(angle, yaw))
    held = rotate(inputs.grasps_BTN2[:, :, 0] - inputs.positions_BTN2[:, :, 0], angle)
    goal = place_of(inputs, candidate)
    tool = torch.where(inputs.has_suction_BT[..., None], goal + held, goal)  # what is pushed is not held
    torch.testing.assert_close(decided[..., 6:8], tool)


def test_what_does_not_exist_is_never_chosen(head, inputs):
    gone = torch.zeros(B, T, N, dtype=torch.bool)
    gone[..., 2] = True
    one = replace(inputs, masks_BTN=gone)
    for kind in ("first_step", "prompt"):
        none = torch.zeros_like(set_of(inputs, kind).masks_BK)
        one = with_objects(one, kind, "masks_BK", none)
    pick = torch.full((B, T), 2)
    assert (head.place(one, candidates_of(one), pick).argmax(-1) == 2).all()
    torch.testing.assert_close(head.decode(one)[..., 0:2], inputs.grasps_BTN2[:, :, 2])


def test_values_behind_the_masks_change_nothing(head, inputs):
    changed = replace(inputs, positions_BTN2=inputs.positions_BTN2.clone())
    changed.positions_BTN2[~inputs.masks_BTN] = 9.0
    hidden = ~inputs.prompt.objects.masks_BK
    for name in ("tokens_BKD", "appearance_BKA", "positions_BK2"):
        value = getattr(inputs.prompt.objects, name).clone()
        value[hidden] = 9.0
        changed = with_objects(changed, "prompt", name, value)
    wanted = targets_at(inputs, place_of(inputs, FIRST_STEP))
    assert torch.equal(head.decode(changed), head.decode(inputs))
    assert torch.equal(head.loss(changed, wanted)[0], head.loss(inputs, wanted)[0])


def test_neither_the_order_in_view_nor_that_of_candidates_changes_action_or_loss(head, inputs):
    order, other = torch.tensor([2, 0, 3, 1]), torch.tensor([1, 0])
    shuffled = in_order(inputs, order)
    for kind, places in (("first_step", order[order < NUM_FIRST]), ("prompt", other)):
        for name in ("tokens_BKD", "masks_BK", "appearance_BKA", "positions_BK2", "image_index_BK"):
            value = getattr(set_of(inputs, kind), name)[:, places]
            shuffled = with_objects(shuffled, kind, name, value)
    torch.testing.assert_close(head.decode(shuffled), head.decode(inputs))
    wanted = targets_at(inputs, place_of(inputs, FIRST_STEP + 1))
    moved = replace(wanted, pick_BT=wanted.pick_BT + 1)  # slot 0 has become slot 1
    torch.testing.assert_close(head.loss(shuffled, moved), head.loss(inputs, wanted))


def test_every_candidate_at_the_demonstrated_place_is_right(head, inputs):
    same = inputs.prompt.objects.positions_BK2.clone()
    same[:, 1] = inputs.first_step.positions_BK2[:, 0] + 0.005
    twice = with_objects(inputs, "prompt", "positions_BK2", same)
    wanted = targets_at(twice, place_of(twice, FIRST_STEP))
    goal = place_of(twice, FIRST_STEP)
    scores = head.place(twice, head.candidates(twice), wanted.pick_BT)
    near, is_known = head.candidates(twice).right(wanted, goal)
    assert near[..., [FIRST_STEP, IN_PROMPT + 1]].all()
    assert is_known.all()
    probabilities = (torch.softmax(scores, dim=-1) * near).sum(-1)
    others = ("offset_weight", "yaw_weight", "appearance_loss_weight", "grounding_loss_weight")
    no_others = replace(head.config, **dict.fromkeys(others, 0.0))
    head.config = no_others
    picks = torch.softmax(head.pick(twice), dim=-1)[..., 0]
    loss, _ = head.loss(twice, wanted)
    torch.testing.assert_close(loss, -(probabilities.log().mean() + picks.log().mean()))


def test_without_a_candidate_there_the_named_object_is_right_and_else_the_nearest_grid_point(head, inputs):
    nowhere = torch.tensor([0.29, -0.43], dtype=torch.float64).expand(B, T, 2)
    known = head.candidates(inputs)
    free = IN_PROMPT + NUM_SCENE
    assert ((known.positions_BTC2[:, :, :free] - nowhere[:, :, None]).norm(dim=-1) > 0.04).all()
    for slot, asked in ((2, 2), (-1, free)):
        right, is_known = known.right(targets_at(inputs, nowhere, place_slot=slot), nowhere)
        assert (right.nonzero()[:, 2].view(B, T) == asked).all()
        assert (is_known == (slot >= 0)).all()


def test_beside_an_off_centre_container_no_other_object_is_right(head, inputs):
    """The middle of the container's box is 6 cm from the goal, another object 2 cm, now and at first."""
    goal = torch.tensor([0.29, -0.43], dtype=torch.float64).expand(B, T, 2)
    positions, first = inputs.positions_BTN2.clone(), inputs.first_step.positions_BK2.clone()
    positions[:, :, 2] = goal + torch.tensor([0.0, 0.06], dtype=torch.float64)
    positions[:, :, 1] = goal + torch.tensor([0.02, 0.0], dtype=torch.float64)
    first[:, 1] = positions[:, 0, 1]
    crowded = with_objects(replace(inputs, positions_BTN2=positions), "first_step", "positions_BK2", first)
    right, is_known = head.candidates(crowded).right(targets_at(crowded, goal, place_slot=2), goal)
    assert (right.nonzero()[:, 2].view(B, T) == 2).all()
    assert is_known.all()
    unnamed, _ = head.candidates(crowded).right(targets_at(crowded, goal), goal)
    assert unnamed[..., [1, FIRST_STEP + 1]].all()
    # The container's place at the first step is right, too, where it is near the goal.
    first[:, 0] = positions[:, 0, 2] = goal[:, 0] + 0.02
    near = with_objects(replace(crowded, positions_BTN2=positions), "first_step", "positions_BK2", first)
    right, _ = head.candidates(near).right(targets_at(near, goal, place_slot=2), goal)
    assert right[:, 0].nonzero()[:, 1].view(B, 2).tolist() == [[2, FIRST_STEP]] * B


def test_steps_that_only_clear_the_way_count_in_the_loss_but_not_in_the_metrics(head, inputs):
    away = torch.tensor([0.29, -0.43], dtype=torch.float64).expand(B, T, 2)
    loss, metrics = head.loss(inputs, targets_at(inputs, away))
    assert loss > 0
    assert (
        metrics["pick_accuracy"]
        == head.loss(inputs, targets_at(inputs, away, place_slot=1))[1]["pick_accuracy"]
    )
    assert all(
        value == 0
        for name, value in metrics.items()
        if name not in ("pick_accuracy", "appearance_accuracy") and not name.startswith("loss/")
    )


@pytest.mark.parametrize("unknown", ["steps_BT", "pick_BT"])
def test_steps_without_a_target_have_no_loss(head, inputs, unknown):
    masks = inputs.masks_BTN.clone()
    masks[0, 0] = False  # as in the padding of a batch
    inputs = replace(inputs, masks_BTN=masks)
    wanted = targets_at(inputs, place_of(inputs, FIRST_STEP))
    value = getattr(wanted, unknown).clone()
    value[0, 0] = False if unknown == "steps_BT" else -1
    partial = replace(wanted, **{unknown: value})
    loss, metrics = head.loss(inputs, partial)
    actions = partial.actions_BTC.clone()
    actions[0, 0, 6:8] += 0.2
    assert head.loss(inputs, replace(partial, actions_BTC=actions)) == (loss, metrics)
    loss.backward()
    assert loss.isfinite()
    assert all(p.grad is None or p.grad.isfinite().all() for p in head.parameters())


def test_a_prompt_without_objects_is_possible(head, inputs):
    blank = with_prompt(inputs, object_mask_BL=torch.zeros_like(inputs.prompt.object_mask_BL))
    for name in ObjectSet.__slots__:
        blank = with_objects(blank, "prompt", name, getattr(inputs.prompt.objects, name)[:, :0])
    assert head.decode(blank).isfinite().all()
    assert head.loss(blank, targets_at(blank, place_of(blank, FIRST_STEP)))[0].isfinite()


@pytest.mark.parametrize(("slot", "counts"), [(2, True), (0, False), (-1, False)])
def test_a_place_at_another_object_in_view_is_trained_by_appearance_too(slot, counts, head, inputs):
    """Not where the object stays where it is, or goes to no object in view."""
    wanted = targets_at(inputs, inputs.positions_BTN2[:, :, 2], place_slot=slot)
    losses = []
    for weight in (0.0, 1.0):
        head.config = replace(head.config, appearance_loss_weight=weight)
        losses.append(head.loss(inputs, wanted)[0])
    pick = torch.zeros(B, T, dtype=torch.int64)
    of_pick = -torch.log_softmax(head.pick.appearance_scores(inputs), dim=-1)[..., 0].mean()
    of_place = -torch.log_softmax(head.place.appearance_scores(inputs, pick), dim=-1)[..., 2].mean()
    torch.testing.assert_close(losses[1] - losses[0], of_pick + of_place * counts)


def test_an_object_similar_to_both_attended_ones_is_picked_rather_than_one_similar_to_one(head, inputs):
    appearance = torch.zeros_like(inputs.appearance_BTNA)
    appearance[:, :, 0, 0] = appearance[:, :, 1, 1] = 1.0
    appearance[:, :, 2, :2] = math.sqrt(0.5)
    marks = torch.zeros_like(inputs.prompt.masked_BLD)
    marks[:, 0, 0] = marks[:, 1, 1] = 100.0
    shown = torch.zeros_like(inputs.prompt.appearance_BLA)
    shown[:, 0, 0] = shown[:, 1, 1] = 1.0
    asking = with_prompt(replace(inputs, appearance_BTNA=appearance), masked_BLD=marks, appearance_BLA=shown)
    pick = head.pick
    with torch.no_grad():
        pick.prompt_key.weight.copy_(torch.eye(D))
        pick.prompt_key.bias.zero_()
        pick.prompt_query.weight.zero_()
        pick.prompt_query.bias.copy_(torch.eye(D)[:2].flatten())
        for weights in (pick.query.weight, pick.query.bias):
            weights.zero_()
    assert (pick(asking).argmax(-1) == 2).all()
    with torch.no_grad():  # the first alone
        pick.logit_scale.bias[1] = -50.0
    assert (pick(asking).argmax(-1) == 0).all()


@pytest.mark.parametrize("what", ["pick", "place"])
def test_words_may_describe_the_appearance_of_object_and_place(what, head, inputs):
    pick = torch.zeros(B, T, dtype=torch.int64)

    def scores(words_BLA, is_word_BL):
        asking = with_prompt(inputs, text_appearance_BLA=words_BLA, describes_BL=is_word_BL)
        return head.pick(asking) if what == "pick" else head.place(asking, head.candidates(asking), pick)

    everywhere = inputs.appearance_BTNA[:, 0, 2][:, None].expand(B, M, A)
    nothing, words = torch.zeros_like(everywhere), torch.ones(B, M, dtype=torch.bool)
    change = (scores(everywhere, words) - scores(nothing, words))[1, 0, :N]
    assert change[:3].argmax() == 2  # the fourth does not exist
    assert change[2] > 5
    # What does not describe says nothing, and takes no attention from what does.
    one = words & (torch.arange(M) == 0)
    unread = everywhere * ~one[..., None]
    assert torch.equal(scores(unread, one), scores(nothing, one))
    assert torch.equal(scores(nothing, None), scores(nothing, one))
    attention = head.pick.grounding.attention(with_prompt(inputs, describes_BL=one).prompt, inputs.query_BTD)
    assert (attention[..., 1:] == 0).all()
    assert (attention[..., 0] > 0).all()
    assert (attention[..., 0] < 1).all()  # the rest goes to no word


def test_the_first_prompt_query_is_trained_to_attend_to_the_most_similar_object(head, inputs):
    """Where none does, as in the third episode, nothing is trained."""
    shown = torch.zeros_like(inputs.prompt.appearance_BLA)
    in_view = torch.zeros_like(inputs.appearance_BTNA)
    in_view[:, :, 0, 0] = 1.0
    shown[0, 1, 0], shown[0, 2, 1] = 1.0, 1.0
    shown[1, 0, 0], shown[1, 2, 0] = 1.0, 0.99
    shown[2, :, 1] = 1.0
    similar = with_prompt(replace(inputs, appearance_BTNA=in_view), appearance_BLA=shown)
    pick = torch.zeros(B, T, dtype=torch.int64)
    loss, is_grounded = head.pick.grounding_nll(similar, pick)
    assert is_grounded.tolist() == [[True] * T, [True] * T, [False] * T]
    optimizer = torch.optim.Adam(head.parameters(), lr=0.05)
    for _ in range(60):
        optimizer.zero_grad()
        loss, _ = head.pick.grounding_nll(similar, pick)
        loss[is_grounded].mean().backward()
        optimizer.step()
    attention = torch.softmax(head.pick._attention_scores(similar), dim=-1)[:, :, 0]
    assert (attention[0, :, 1] > 0.9).all()
    assert (attention[1, :, [0, 2]].sum(-1) > 0.9).all()
    hidden = with_prompt(similar, object_mask_BL=torch.zeros(B, M, dtype=torch.bool))
    assert not head.pick.grounding_nll(hidden, pick)[1].any()


def previous(inputs: HeadInputs, start: int, place_BT2) -> HeadInputs:
    """The same after actions that picked there (start 0), or put there (start 6)."""
    actions = inputs.previous_BTC.clone()
    actions[:, 1:, start : start + 2] = place_BT2[:, 1:]
    return replace(inputs, previous_BTC=actions)


@pytest.mark.parametrize("start", [0, 6])
def test_what_to_pick_depends_on_where_the_last_object_was_picked_and_put(head, inputs, start):
    elsewhere = previous(inputs, start, inputs.positions_BTN2[:, :, 2] + 0.05)
    before, after = torch.softmax(head.pick(inputs), -1), torch.softmax(head.pick(elsewhere), -1)
    assert torch.equal(after[:, 0], before[:, 0])  # nothing was taken before it
    assert ((after[:, 1] - before[:, 1]).abs().amax(-1) > 1e-3).all()


def test_the_pick_depends_on_neighbours_and_on_what_a_scene_shows_there(head, inputs):
    before = head.pick(inputs)
    scenes = inputs.prompt.objects.positions_BK2.clone()
    scenes[:, 1] = inputs.positions_BTN2[:, 0, 1] + 0.01  # the second object lies where another one shall be
    after = head.pick(with_objects(inputs, "prompt", "positions_BK2", scenes))
    assert ((after - before)[:, 0, 1].abs() > 1e-6).all()
    close = inputs.positions_BTN2.clone()
    close[:, 0, 3] = close[:, 0, 1] + 0.01  # in the second episode there is no fourth object
    changed = (head.pick(replace(inputs, positions_BTN2=close)) - before)[:, 0, 1].abs()
    assert (changed > 1e-6).tolist() == [True, False, True]


def test_rotations_shown_in_the_prompt_are_copied(inputs):
    torch.manual_seed(0)
    head = CandidatePointerHead(CandidateHeadConfig(hidden_width=16), D, rotation_bins=72).double()
    torch.nn.init.zeros_(head.yaw.weight)
    torch.nn.init.zeros_(head.yaw.bias)
    rotations = torch.zeros(B, NUM_SCENE, 72, dtype=torch.float64)
    rotations[:, 1, 66] = 1.0  # the first object has no earlier image
    shown = with_objects(inputs, "prompt", "rotations_BKR", rotations)
    expected = torch.full((B, T), math.radians(-30), dtype=torch.float64)
    none = torch.zeros_like(inputs.rotations_BTNR)
    still = replace(shown, rotations_BTNR=none)
    torch.testing.assert_close(yaw_between(head.decode(still)), expected)
    # So is that of the picked object to how the prompt shows it, and of no other object.
    with torch.no_grad():
        head.rotation_copy.weight.bias.fill_(-50.0)
    head.pick.forward = lambda inputs: torch.eye(N)[torch.full((B, T), 2)]
    turned = none.clone()
    turned[:, :, 2, 6] = turned[:, :, 1, 12] = 1.0
    torch.testing.assert_close(yaw_between(head.decode(replace(shown, rotations_BTNR=turned))), -expected)
