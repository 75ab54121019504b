"""The copying head: which places it may choose, what it learns to copy, where it brings what it holds."""

import math
from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from openvima.policies.heads.candidates import (  # noqa: E402
    candidate_masks,
    candidate_positions,
    right_candidates,
)
from openvima.policies.heads.copying import CopyingConfig, CopyingHead  # noqa: E402
from openvima.policies.heads.pointing import at, turn_of, turned  # noqa: E402

from openvima.errors import ConfigError  # noqa: E402
from openvima.policies.nn.actions import ActionTargets, HeadInputs, Recollection, Remembered  # noqa: E402

B, T, N, M, D, A = 3, 2, 4, 3, 8, 5
NUM_FIRST, NUM_SCENE = 3, 2
IN_VIEW, AT_FIRST, IN_PROMPT = 0, N, N + NUM_FIRST  # number of the first candidate of each kind


@pytest.fixture
def head() -> CopyingHead:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = CopyingHead(CopyingConfig(hidden_width=16), D).double()
        torch.nn.init.normal_(network.offset.weight, std=0.1)  # it starts at zero
        return network


def drawn_inputs(batch: int = B, seed: int = 1) -> HeadInputs:
    generator = torch.Generator().manual_seed(seed)

    def drawn(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def looks(*shape):
        return torch.nn.functional.normalize(drawn(*shape, A), dim=-1)

    def places(*shape):
        low, size = torch.tensor([0.3, -0.4]), torch.tensor([0.4, 0.8])
        return low + size * torch.rand(*shape, 2, generator=generator).double()

    def remembered(count):
        exist = torch.ones(batch, count, dtype=torch.bool)
        numbers = torch.arange(count).expand(batch, count)
        return Remembered(drawn(batch, count, D), exist, looks(batch, count), places(batch, count), numbers)

    positions = places(batch, T, N)
    lifts = torch.tensor([[True, True], [False, False], [True, False]])
    return HeadInputs(
        query_BTD=drawn(batch, T, D),
        objects_BTND=drawn(batch, T, N, D),
        masks_BTN=torch.ones(batch, T, N, dtype=torch.bool),
        appearance_BTNA=looks(batch, T, N),
        positions_BTN2=positions,
        grasps_BTN2=positions + 0.01,
        lifts_BT=lifts.repeat(batch // B + 1, 1)[:batch],
        prompt_BMD=drawn(batch, M, D),
        prompt_masks_BM=torch.ones(batch, M, dtype=torch.bool),
        prompt_appearance_BMA=looks(batch, M),
        recollection=Recollection(remembered(NUM_FIRST), remembered(NUM_SCENE), torch.arange(T)),
        previous_BTC=drawn(batch, T, 12) * (torch.arange(T) > 0)[:, None],
        word_looks_BMA=torch.zeros(batch, M, A, dtype=torch.float64),
        prompt_exists_BM=torch.ones(batch, M, dtype=torch.bool),
    )


@pytest.fixture
def inputs() -> HeadInputs:
    """Three episodes; some of what the second one sees and remembers does not exist."""
    whole = drawn_inputs()
    masks = whole.masks_BTN.clone()
    masks[1, :, 3] = False
    return remembering(replace(whole, masks_BTN=masks), "scenes", "masks_BK", [[1, 1], [0, 1], [1, 1]])


def remembering(inputs: HeadInputs, kind: str, name: str, value) -> HeadInputs:
    """The same with another memory."""
    old = getattr(inputs.recollection, kind)
    new = replace(old, **{name: torch.as_tensor(value, dtype=getattr(old, name).dtype)})
    return replace(inputs, recollection=replace(inputs.recollection, **{kind: new}))


def targets_at(inputs: HeadInputs, place_BT2, *, yaw: float = 0.0, place_slot: int = -1) -> ActionTargets:
    """Pick slot 0 a centimetre beside the grasp point, and bring its centre to a place."""
    batch = len(inputs.masks_BTN)
    held = inputs.grasps_BTN2[:, :, 0] + 0.01 - inputs.positions_BTN2[:, :, 0]
    actions = torch.zeros(batch, T, 12, dtype=torch.float64)
    actions[..., 0:2] = inputs.positions_BTN2[:, :, 0] + held
    tool = place_BT2 + turned(held, torch.full((batch, T), yaw, dtype=torch.float64))
    actions[..., 6:8] = torch.where(inputs.lifts_BT[..., None], tool, place_BT2)
    actions[..., 5], actions[..., 10], actions[..., 11] = 1, math.sin(yaw / 2), math.cos(yaw / 2)
    slots = torch.zeros(batch, T, dtype=torch.int64)
    return ActionTargets(actions, slots, slots + place_slot, torch.ones(batch, T, dtype=torch.bool))


def place_of(inputs: HeadInputs, candidate: int) -> "torch.Tensor":
    return candidate_positions(inputs)[:, :, candidate]


def test_candidates_are_what_is_in_view_then_what_was_and_then_what_the_prompt_shows(inputs):
    positions = candidate_positions(inputs)
    kept = inputs.recollection
    assert torch.equal(positions[:, :, :N], inputs.positions_BTN2)
    assert torch.equal(positions[:, 1, AT_FIRST:IN_PROMPT], kept.first.positions_BK2)
    assert torch.equal(positions[:, 1, IN_PROMPT:], kept.scenes.positions_BK2)
    assert candidate_masks(inputs)[1, 0].tolist() == [True] * 3 + [False] + [True] * 3 + [False, True]


@pytest.mark.parametrize("candidate", [IN_VIEW + 1, AT_FIRST + 2, IN_PROMPT + 1])
@pytest.mark.parametrize("yaw", [0.0, math.radians(60)])
def test_the_centre_goes_to_the_candidate_however_the_object_is_held_and_turned(head, inputs, candidate, yaw):
    only = torch.full((B, T), candidate)
    head.pick.forward = lambda inputs: torch.eye(N)[torch.zeros(B, T, dtype=torch.int64)]
    head.place.forward = lambda inputs, pick: torch.eye(N + NUM_FIRST + NUM_SCENE)[only].double()
    torch.nn.init.zeros_(head.offset.weight)
    torch.nn.init.constant_(head.yaw.bias, -50.0)
    with torch.no_grad():
        head.yaw.bias[round(math.degrees(yaw) / 5)] = 50.0
    decided = head.decide(inputs)
    torch.testing.assert_close(decided[..., 0:2], inputs.grasps_BTN2[:, :, 0])
    turn = turn_of(decided)
    torch.testing.assert_close(turn, torch.full_like(turn, yaw))
    held = turned(inputs.grasps_BTN2[:, :, 0] - inputs.positions_BTN2[:, :, 0], turn)
    goal = place_of(inputs, candidate)
    tool = torch.where(inputs.lifts_BT[..., None], goal + held, goal)  # what is pushed is not held
    torch.testing.assert_close(decided[..., 6:8], tool)


def test_what_does_not_exist_is_never_chosen(head, inputs):
    gone = torch.zeros(B, T, N, dtype=torch.bool)
    gone[..., 2] = True
    one = replace(inputs, masks_BTN=gone)
    for kind in ("first", "scenes"):
        none = torch.zeros_like(getattr(inputs.recollection, kind).masks_BK)
        one = remembering(one, kind, "masks_BK", none)
    pick = torch.full((B, T), 2)
    assert (head.place(one, pick).argmax(-1) == 2).all()
    torch.testing.assert_close(head.decide(one)[..., 0:2], inputs.grasps_BTN2[:, :, 2])


def test_values_behind_the_masks_change_nothing(head, inputs):
    changed = replace(inputs, positions_BTN2=inputs.positions_BTN2.clone())
    changed.positions_BTN2[~inputs.masks_BTN] = 9.0
    hidden = ~inputs.recollection.scenes.masks_BK
    for name in ("tokens_BKD", "appearance_BKA", "positions_BK2"):
        value = getattr(inputs.recollection.scenes, name).clone()
        value[hidden] = 9.0
        changed = remembering(changed, "scenes", name, value)
    wanted = targets_at(inputs, place_of(inputs, AT_FIRST))
    assert torch.equal(head.decide(changed), head.decide(inputs))
    assert torch.equal(head.loss(changed, wanted)[0], head.loss(inputs, wanted)[0])


def test_neither_the_order_in_view_nor_that_in_memory_changes_action_or_loss(head, inputs):
    order, other = torch.tensor([2, 0, 3, 1]), torch.tensor([1, 0])
    shuffled = replace(
        inputs,
        objects_BTND=inputs.objects_BTND[:, :, order],
        masks_BTN=inputs.masks_BTN[:, :, order],
        appearance_BTNA=inputs.appearance_BTNA[:, :, order],
        positions_BTN2=inputs.positions_BTN2[:, :, order],
        grasps_BTN2=inputs.grasps_BTN2[:, :, order],
    )
    for kind, places in (("first", order[order < NUM_FIRST]), ("scenes", other)):
        for name in ("tokens_BKD", "masks_BK", "appearance_BKA", "positions_BK2", "numbers_BK"):
            value = getattr(getattr(inputs.recollection, kind), name)[:, places]
            shuffled = remembering(shuffled, kind, name, value)
    torch.testing.assert_close(head.decide(shuffled), head.decide(inputs))
    wanted = targets_at(inputs, place_of(inputs, AT_FIRST + 1))
    moved = replace(wanted, pick_BT=wanted.pick_BT + 1)  # slot 0 has become slot 1
    torch.testing.assert_close(head.loss(shuffled, moved), head.loss(inputs, wanted))


def test_every_candidate_at_the_demonstrated_place_is_right(head, inputs):
    same = inputs.recollection.scenes.positions_BK2.clone()
    same[:, 1] = inputs.recollection.first.positions_BK2[:, 0] + 0.005
    twice = remembering(inputs, "scenes", "positions_BK2", same)
    wanted = targets_at(twice, place_of(twice, AT_FIRST))
    goal = place_of(twice, AT_FIRST)
    scores = head.place(head.with_free_points(twice), wanted.pick_BT)
    near, is_told = right_candidates(head.with_free_points(twice), wanted, goal)
    assert near[..., [AT_FIRST, IN_PROMPT + 1]].all()
    assert is_told.all()
    chances = (torch.softmax(scores, dim=-1) * near).sum(-1)
    others = ("offset_weight", "yaw_weight", "look_weight", "shown_weight")
    no_others = replace(head.config, **dict.fromkeys(others, 0.0))
    head.config = no_others
    picks = torch.softmax(head.pick(twice), dim=-1)[..., 0]
    loss, _ = head.loss(twice, wanted)
    torch.testing.assert_close(loss, -(chances.log().mean() + picks.log().mean()))


def test_without_a_candidate_there_the_named_object_is_right_and_else_the_nearest_free_point(head, inputs):
    nowhere = torch.tensor([0.29, -0.43], dtype=torch.float64).expand(B, T, 2)
    known = head.with_free_points(inputs)
    free = IN_PROMPT + NUM_SCENE
    assert ((candidate_positions(known)[:, :, :free] - nowhere[:, :, None]).norm(dim=-1) > 0.04).all()
    for slot, asked in ((2, 2), (-1, free)):
        right, is_told = right_candidates(known, targets_at(inputs, nowhere, place_slot=slot), nowhere)
        assert (right.nonzero()[:, 2].view(B, T) == asked).all()
        assert (is_told == (slot >= 0)).all()


def test_steps_that_only_clear_the_way_count_in_the_loss_but_not_in_the_metrics(head, inputs):
    away = torch.tensor([0.29, -0.43], dtype=torch.float64).expand(B, T, 2)
    loss, metrics = head.loss(inputs, targets_at(inputs, away))
    assert loss > 0
    assert (
        metrics["pick_accuracy"]
        == head.loss(inputs, targets_at(inputs, away, place_slot=1))[1]["pick_accuracy"]
    )
    assert all(
        value == 0 for name, value in metrics.items() if name not in ("pick_accuracy", "look_accuracy")
    )


@pytest.mark.parametrize("unknown", ["steps_BT", "pick_BT"])
def test_steps_without_a_target_have_no_loss(head, inputs, unknown):
    masks = inputs.masks_BTN.clone()
    masks[0, 0] = False  # as in the padding of a batch
    inputs = replace(inputs, masks_BTN=masks)
    wanted = targets_at(inputs, place_of(inputs, AT_FIRST))
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


def test_a_prompt_that_shows_nothing_is_possible(head, inputs):
    blank = replace(
        inputs,
        prompt_BMD=inputs.prompt_BMD[:, :0],
        prompt_masks_BM=inputs.prompt_masks_BM[:, :0],
        prompt_appearance_BMA=inputs.prompt_appearance_BMA[:, :0],
        word_looks_BMA=inputs.word_looks_BMA[:, :0],
        prompt_exists_BM=inputs.prompt_exists_BM[:, :0],
    )
    for name in ("tokens_BKD", "masks_BK", "appearance_BKA", "positions_BK2", "numbers_BK"):
        blank = remembering(blank, "scenes", name, getattr(inputs.recollection.scenes, name)[:, :0])
    assert head.decide(blank).isfinite().all()
    assert head.loss(blank, targets_at(blank, place_of(blank, AT_FIRST)))[0].isfinite()


def test_the_loss_of_looks_teaches_what_is_attended_to_and_not_how_much_looks_count(head, inputs):
    words = torch.eye(A, dtype=torch.float64)[:M].expand(B, M, A)
    inputs = replace(inputs, word_looks_BMA=words)
    chances = torch.softmax(head.pick.by_looks(inputs), dim=-1)[..., 0]
    (-chances.log().mean()).backward()
    taught = {name for name, parameter in head.named_parameters() if parameter.grad is not None}
    assert taught == {
        f"pick.{of}{name}.{part}"
        for of in ("prompt_", "described.")
        for name in ("query", "key")
        for part in ("weight", "bias")
    }


@pytest.mark.parametrize(("slot", "counts"), [(2, True), (0, False), (-1, False)])
def test_a_place_at_another_object_in_view_is_taught_by_looks_too(slot, counts, head, inputs):
    """Not where the object stays where it is, or goes to no object in view."""
    wanted = targets_at(inputs, inputs.positions_BTN2[:, :, 2], place_slot=slot)
    losses = []
    for weight in (0.0, 1.0):
        head.config = replace(head.config, look_weight=weight)
        losses.append(head.loss(inputs, wanted)[0])
    pick = torch.zeros(B, T, dtype=torch.int64)
    of_pick = -torch.log_softmax(head.pick.by_looks(inputs), dim=-1)[..., 0].mean()
    of_place = -torch.log_softmax(head.place.by_looks(inputs, pick), dim=-1)[..., 2].mean()
    torch.testing.assert_close(losses[1] - losses[0], of_pick + of_place * counts)


def test_looks_of_places_are_those_that_the_place_is_scored_by(head, inputs):
    """What is asked for changes the scores of objects in view by as much as it changes those by looks."""
    pick, known = torch.zeros(B, T, dtype=torch.int64), head.with_free_points(inputs)
    other = replace(known, prompt_appearance_BMA=known.prompt_appearance_BMA.flip(1))
    whole = (head.place(other, pick) - head.place(known, pick))[..., :N]
    looks = head.place.by_looks(other, pick) - head.place.by_looks(known, pick)
    torch.testing.assert_close(whole, looks)


def test_what_looks_like_both_that_are_asked_for_is_picked_rather_than_what_looks_like_one(head, inputs):
    appearance = torch.zeros_like(inputs.appearance_BTNA)
    appearance[:, :, 0, 0] = appearance[:, :, 1, 1] = 1.0
    appearance[:, :, 2, :2] = math.sqrt(0.5)
    marks = torch.zeros_like(inputs.prompt_BMD)
    marks[:, 0, 0] = marks[:, 1, 1] = 100.0
    looks = torch.zeros_like(inputs.prompt_appearance_BMA)
    looks[:, 0, 0] = looks[:, 1, 1] = 1.0
    asking = replace(inputs, appearance_BTNA=appearance, prompt_BMD=marks, prompt_appearance_BMA=looks)
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
        pick.sharpness.bias[1] = -50.0
    assert (pick(asking).argmax(-1) == 0).all()


@pytest.mark.parametrize("what", ["pick", "place"])
def test_words_may_describe_how_that_looks_which_is_picked_or_put_at(what, head, inputs):
    pick = torch.zeros(B, T, dtype=torch.int64)
    known = head.with_free_points(inputs)

    def scores(words_BMA, is_word_BM):
        asking = replace(known, word_looks_BMA=words_BMA, prompt_exists_BM=is_word_BM)
        return head.pick(asking) if what == "pick" else head.place(asking, pick)

    everywhere = inputs.appearance_BTNA[:, 0, 2][:, None].expand(B, M, A)
    nothing, words = torch.zeros_like(everywhere), torch.ones(B, M, dtype=torch.bool)
    change = (scores(everywhere, words) - scores(nothing, words))[1, 0, :N]
    assert change[:3].argmax() == 2  # the fourth does not exist
    assert change[2] > 5
    # What is no word says nothing.
    one = words & (torch.arange(M) == 0)
    unread = everywhere * ~one[..., None]
    assert torch.equal(scores(unread, one), scores(nothing, one))


def test_the_first_asked_object_is_taught_to_be_what_looks_like_the_picked_one(head, inputs):
    """Where none does, as in the third episode, nothing is taught."""
    looks = torch.zeros_like(inputs.prompt_appearance_BMA)
    seen = torch.zeros_like(inputs.appearance_BTNA)
    seen[:, :, 0, 0] = 1.0
    looks[0, 1, 0], looks[0, 2, 1] = 1.0, 1.0
    looks[1, 0, 0], looks[1, 2, 0] = 1.0, 0.99
    looks[2, :, 1] = 1.0
    shown = replace(inputs, appearance_BTNA=seen, prompt_appearance_BMA=looks)
    pick = torch.zeros(B, T, dtype=torch.int64)
    surprise, is_shown = head.pick.surprise_at_shown(shown, pick)
    assert is_shown.tolist() == [[True] * T, [True] * T, [False] * T]
    optimizer = torch.optim.Adam(head.parameters(), lr=0.05)
    for _ in range(60):
        optimizer.zero_grad()
        surprise, _ = head.pick.surprise_at_shown(shown, pick)
        surprise[is_shown].mean().backward()
        optimizer.step()
    asked = torch.softmax(head.pick._asked(shown), dim=-1)[:, :, 0]
    assert (asked[0, :, 1] > 0.9).all()
    assert (asked[1, :, [0, 2]].sum(-1) > 0.9).all()
    hidden = replace(shown, prompt_masks_BM=torch.zeros(B, M, dtype=torch.bool))
    assert not head.pick.surprise_at_shown(hidden, pick)[1].any()


@pytest.mark.parametrize(("kind", "first"), [("first", AT_FIRST), ("scenes", IN_PROMPT)])
@pytest.mark.slow
def test_it_learns_to_copy_the_place_of_what_looks_alike_and_does_so_for_looks_never_seen(kind, first):
    """Objects differ from step to step; that a remembered one looks like the picked one stays the same."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        head = CopyingHead(CopyingConfig(hidden_width=16), D).double()

    def example(seed: int) -> tuple[HeadInputs, ActionTargets]:
        drawn = drawn_inputs(batch=32, seed=seed)
        looks = getattr(drawn.recollection, kind).appearance_BKA.clone()
        alike = torch.randint(looks.shape[1], (32,), generator=torch.Generator().manual_seed(seed))
        appearance = drawn.appearance_BTNA.clone()
        rows = torch.arange(32)
        appearance[:, :, 0] = looks[rows, alike][:, None]
        prompt = looks[rows, alike][:, None].expand(-1, M, -1)
        drawn = replace(drawn, appearance_BTNA=appearance, prompt_appearance_BMA=prompt)
        place = candidate_positions(drawn)[rows, :, first + alike]
        return drawn, targets_at(drawn, place)

    optimizer = torch.optim.Adam(head.parameters(), lr=0.01)
    for step in range(60):
        optimizer.zero_grad()
        loss, _ = head.loss(*example(step))
        loss.backward()
        optimizer.step()
    _, metrics = head.loss(*example(1000))
    assert metrics["pick_accuracy"] > 0.97
    assert metrics["place_accuracy"] > 0.9
    assert metrics["accuracy"] > 0.9


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


def test_only_the_places_of_the_last_action_count_and_all_that_is_far_counts_alike(head, inputs):
    turned_tool = inputs.previous_BTC.clone()
    turned_tool[:, 1:, [2, 3, 4, 5, 8, 9, 10, 11]] += 1.0
    assert torch.equal(head.pick(replace(inputs, previous_BTC=turned_tool)), head.pick(inputs))
    far, farther = (previous(inputs, 0, torch.full((B, T, 2), value)) for value in (50.0, 60.0))
    assert torch.equal(head.pick(far), head.pick(farther))


def test_at_the_first_step_nothing_of_a_previous_action_counts(head, inputs):
    before = head.pick(inputs)
    with torch.no_grad():
        head.pick.lying[0].weight[:, :7] += 1.0
    assert torch.equal(head.pick(inputs)[:, 0], before[:, 0])
    assert not torch.allclose(head.pick(inputs)[:, 1], before[:, 1])


def test_what_to_pick_depends_on_what_lies_beside_and_on_what_a_scene_shows_there(head, inputs):
    before = head.pick(inputs)
    scenes = inputs.recollection.scenes.positions_BK2.clone()
    scenes[:, 1] = inputs.positions_BTN2[:, 0, 1] + 0.01  # the second object lies where another one shall be
    after = head.pick(remembering(inputs, "scenes", "positions_BK2", scenes))
    assert ((after - before)[:, 0, 1].abs() > 1e-6).all()
    close = inputs.positions_BTN2.clone()
    close[:, 0, 3] = close[:, 0, 1] + 0.01  # in the second episode there is no fourth object
    changed = (head.pick(replace(inputs, positions_BTN2=close)) - before)[:, 0, 1].abs()
    assert (changed > 1e-6).tolist() == [True, False, True]


@pytest.mark.slow
def test_it_learns_to_pick_what_lies_where_the_last_object_was_put():
    """Tokens and looks are drawn anew, so nothing else tells the objects apart."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        head = CopyingHead(CopyingConfig(hidden_width=16), D).double()

    def example(seed: int) -> tuple[HeadInputs, ActionTargets]:
        drawn = drawn_inputs(batch=64, seed=seed)
        drawn = previous(drawn, 6, drawn.positions_BTN2[:, :, 0])
        wanted = targets_at(drawn, drawn.positions_BTN2[:, :, 1])
        is_second = (torch.arange(T) > 0).expand(64, T)
        return drawn, replace(wanted, steps_BT=is_second)

    optimizer = torch.optim.Adam(head.parameters(), lr=0.01)
    for step in range(80):
        optimizer.zero_grad()
        loss, _ = head.loss(*example(step))
        loss.backward()
        optimizer.step()
    assert head.loss(*example(1000))[1]["pick_accuracy"] > 0.8  # by chance a quarter


def test_turns_that_the_prompt_shows_are_copied(inputs):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        head = CopyingHead(CopyingConfig(hidden_width=16), D, turn_bins=72).double()
    torch.nn.init.zeros_(head.yaw.weight)
    torch.nn.init.zeros_(head.yaw.bias)
    turns = torch.zeros(B, NUM_SCENE, 72, dtype=torch.float64)
    turns[:, 1, 66] = 1.0  # the first object has no picture to be compared with
    kept = replace(inputs.recollection.scenes, turns_BKR=turns)
    shown = replace(inputs, recollection=replace(inputs.recollection, scenes=kept))
    expected = torch.full((B, T), math.radians(-30), dtype=torch.float64)
    torch.testing.assert_close(turn_of(head.decide(shown)) - 0.0, expected)


def test_with_a_kept_place_in_the_batch_the_chosen_one_is_still_that_of_its_own_episode(head, inputs):
    first = inputs.recollection.first.select([2, 0])
    assert torch.equal(first.positions_BK2, inputs.recollection.first.positions_BK2[[2, 0]])
    place = torch.tensor([[1, AT_FIRST], [IN_PROMPT, 0], [AT_FIRST + 2, IN_PROMPT + 1]])
    got = at(candidate_positions(inputs), place)
    for b in range(B):
        for t in range(T):
            assert torch.equal(got[b, t], candidate_positions(inputs)[b, t, place[b, t]])


@pytest.mark.parametrize(
    "sizes", [{"num_yaw_bins": 1}, {"hidden_width": 0}, {"num_numbers": 0}, {"num_asked": 0}]
)
def test_sizes_that_make_no_sense_are_refused(sizes):
    with pytest.raises(ConfigError, match="copying head"):
        CopyingConfig(**sizes)
