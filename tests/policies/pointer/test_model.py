"""The network that copies and compares: what it keeps of an episode, and what must not matter to it."""

import re
from dataclasses import fields, replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from openvima.data.object_cache.episode import preprocess  # noqa: E402
from openvima.data.records import Demonstration, rollout_oracle  # noqa: E402
from openvima.env import TabletopEnv  # noqa: E402
from openvima.perception.objects import GROUND_TRUTH, ObjectViews  # noqa: E402
from openvima.policies import preset  # noqa: E402
from openvima.policies.build import build_network  # noqa: E402
from openvima.policies.config import PolicyConfig  # noqa: E402
from openvima.policies.inference import NetworkPolicy  # noqa: E402
from openvima.policies.nn.actions import ACTION_PARTS, HeadInputs, Remembered  # noqa: E402
from openvima.policies.nn.policy_network import PolicyNetwork  # noqa: E402
from openvima.policies.processor import Processor  # noqa: E402
from openvima.policies.tokenizer import texture_word_ids, word_ids  # noqa: E402
from openvima.training.inverse_dynamics import as_motion  # noqa: E402
from small_networks import narrow_small  # noqa: E402
from training_examples import collate_examples, examples_of  # noqa: E402

TASKS = ("rearrange_then_restore", "follow_order", "twist", "visual_manipulation", "scene_understanding")


@pytest.fixture(scope="module")
def demos() -> list[Demonstration]:
    """One of each task, of one to several steps."""
    runs = [rollout_oracle(TabletopEnv(task, level="train", domain="user"), 1) for task in TASKS]
    assert {run.num_steps for run in runs} >= {1, 2}
    return runs


def network_of(config: PolicyConfig) -> PolicyNetwork:
    network = build_network(config, seed=3).eval()
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return network


@pytest.fixture(scope="module")
def network() -> PolicyNetwork:
    return network_of(narrow_small()).double()


@torch.no_grad()
def read_whole(network: PolicyNetwork, demos, taken_BTC=None) -> tuple[HeadInputs, "torch.Tensor"]:
    """What the head is given for all steps of some demonstrations, and what it decides.

    Actions are those of the demonstrations, or others that were taken.
    """
    processor = Processor.of(network.config.inputs)
    examples, images = examples_of(demos, processor)
    batch = collate_examples(processor, examples)
    features = network.encode_images(images)
    memory = network.encode_prompt(batch.prompts, features)
    actions_BTC = batch.targets.actions_BTC if taken_BTC is None else taken_BTC
    inputs = network(memory, batch.history, features, actions_BTC)
    return inputs, network.head.decide(inputs)


@torch.no_grad()
def read_stepwise(network: PolicyNetwork, demo: Demonstration) -> list[HeadInputs]:
    """The same as one episode is played, with the actions of the demonstration."""
    processor = Processor.of(network.config.inputs)
    (example,), images = examples_of([demo], processor)
    batch = collate_examples(processor, [example])
    features = network.encode_images(images)
    memory = network.encode_prompt(batch.prompts, features)
    state, given = network.begin(memory), []
    actions = torch.cat([torch.zeros(1, 1, 12), batch.targets.actions_BTC], dim=1)
    for t in range(demo.num_steps):
        now = slice(t, t + 1)
        step = type(batch.history)(
            *(getattr(batch.history, field.name)[:, now] for field in fields(batch.history))
        )
        has_previous = torch.full((1, 1), t > 0)
        inputs, state = network.extend(memory, state, step, features, actions[:, now], has_previous)
        given.append(inputs)
    return given


def test_reading_step_by_step_gives_the_head_what_reading_at_once_does(network, demos):
    whole, decided = read_whole(network, demos)
    for b, demo in enumerate(demos):
        for t, now in enumerate(read_stepwise(network, demo)):
            count = now.masks_BTN.shape[2]
            torch.testing.assert_close(now.query_BTD[0, 0], whole.query_BTD[b, t])
            torch.testing.assert_close(now.objects_BTND[0, 0], whole.objects_BTND[b, t, :count])
            torch.testing.assert_close(now.previous_BTC[0, 0], whole.previous_BTC[b, t])
            assert now.recollection.steps_T.tolist() == [t]
            for kind in ("first", "scenes"):
                one, all_of_them = getattr(now.recollection, kind), getattr(whole.recollection, kind)
                exist = one.masks_BK[0]
                assert all_of_them.masks_BK[b].sum() == exist.sum()
                for field in fields(Remembered):
                    if (value := getattr(one, field.name)) is not None:
                        others = getattr(all_of_them, field.name)[b, : len(exist)]
                        torch.testing.assert_close(value[0][exist], others[exist])
            torch.testing.assert_close(network.head.decide(now)[0, 0], decided[b, t])


def test_acting_in_a_batch_decides_what_reading_whole_histories_does(network, demos):
    policy, several = NetworkPolicy(network), [demo for demo in demos if demo.num_steps > 1]
    policy.reset([demo.prompt for demo in several])
    taken = torch.zeros(len(several), max(demo.num_steps for demo in several), 12)
    for t in range(taken.shape[1]):
        observations = [demo.observation(t) if t < demo.num_steps else None for demo in several]
        for b, action in enumerate(policy.act(observations)):
            if action is not None:
                taken[b, t] = torch.from_numpy(np.concatenate([action[key] for key in ACTION_PARTS]))
    inputs, decided = read_whole(network, several, taken)
    others = read_whole(network, several, taken.roll(1, 0))[0]
    for b, demo in enumerate(several):
        steps = slice(demo.num_steps)
        torch.testing.assert_close(decided[b, steps].float(), taken[b, steps])
        torch.testing.assert_close(inputs.previous_BTC[b, 1 : demo.num_steps], taken[b, : demo.num_steps - 1])
        assert (inputs.previous_BTC[b, 0] == 0).all()
        assert (inputs.previous_BTC[b, demo.num_steps :] == 0).all()
    # Other actions before it, with the tokens as they were: other scores.
    mixed = replace(inputs, previous_BTC=others.previous_BTC)
    changed = (network.head.pick(mixed) - network.head.pick(inputs)).abs().amax(-1)
    assert (changed[:, 0] == 0).all()
    assert (changed[:, 1] > 1e-6).all()


def test_the_first_observation_stays_in_memory_and_pictures_of_single_objects_are_no_places(network, demos):
    inputs, _ = read_whole(network, demos)
    first, scenes = inputs.recollection.first, inputs.recollection.scenes
    assert torch.equal(first.positions_BK2, inputs.positions_BTN2[:, 0])
    assert torch.equal(first.masks_BK, inputs.masks_BTN[:, 0])
    shown = {task: scenes.masks_BK[b].sum().item() for b, task in enumerate(TASKS)}
    records = [sum(len(image.objects) for image in demo.prompt.images.values()) for demo in demos]
    assert shown == {**dict(zip(TASKS, records, strict=True)), "visual_manipulation": 0}


def test_places_keep_all_their_digits_in_half_precision(demos):
    inputs, decided = read_whole(network_of(narrow_small()).bfloat16(), demos)
    for positions in (inputs.recollection.first.positions_BK2, inputs.recollection.scenes.positions_BK2):
        assert positions.dtype == torch.float32
    assert decided.isfinite().all()


def test_sessions_have_memories_of_their_own(network, demos):
    policy = NetworkPolicy(network)
    other = policy.new_session()
    long, another = demos[0], demos[1]
    policy.reset([long.prompt])
    first = policy.act([long.observation(0)])
    other.reset([another.prompt, long.prompt])
    other.act([another.observation(0), long.observation(1)])
    other.act([None, long.observation(0)])
    second = policy.act([long.observation(1)])
    policy.reset([another.prompt, long.prompt])
    for t, expected in ((0, first), (1, second)):
        got = policy.act([another.observation(t), long.observation(t)])[1]
        for key, value in expected[0].items():
            np.testing.assert_array_equal(got[key], value)


def test_it_survives_its_files(demos, tmp_path):
    policy = NetworkPolicy(network_of(narrow_small()))
    policy.save_pretrained(tmp_path / "small")
    again = NetworkPolicy.from_pretrained(tmp_path / "small")
    assert again.network.config == policy.network.config == narrow_small()
    observation = demos[0].observation(0)
    for each in (policy, again):
        each.reset([demos[0].prompt])
    (ours,), (theirs,) = policy.act([observation]), again.act([observation])
    assert all(np.allclose(ours[key], theirs[key], atol=1e-6) for key in ours)


def test_without_comparisons_it_copies_places_but_estimates_no_turns(demos):
    network = network_of(replace(narrow_small(), comparison=None)).double()
    inputs, decided = read_whole(network, demos)
    assert inputs.recollection.scenes.turns_BKR is None
    assert decided.isfinite().all()


def test_comparisons_serve_the_other_heads_as_well(demos):
    for head in ("nano", "nano-bins"):
        network = network_of(replace(narrow_small(), head=preset(head).head)).double()
        inputs, decided = read_whole(network, demos)
        assert inputs.recollection is None
        assert decided.isfinite().all()


def test_prompts_say_which_image_shows_an_object_and_whether_that_is_the_table(demos):
    processor = Processor("objects")
    for demo, task in zip(demos, TASKS, strict=True):
        batch, _ = processor.encode_prompts([demo.prompt])
        counts = [len(image.objects) for image in demo.prompt.images.values()]
        assert batch.image_index_S.tolist() == np.repeat(np.arange(len(counts)), counts).tolist()
        kinds = [image.kind == "scene" for image in demo.prompt.images.values()]
        assert batch.in_scene_S.tolist() == np.repeat(kinds, counts).tolist(), task
        objects = [GROUND_TRUTH.in_prompt_image(image) for image in demo.prompt.images.values()]
        np.testing.assert_array_equal(batch.positions_S2, ObjectViews.concatenated(objects).positions())


def test_pictures_of_single_objects_do_not_change_what_pictures_of_the_table_tell(network, demos):
    """Following a motion is the same task whether or not the prompt also names the object that moves."""
    frames, alone = demos[1].prompt, demos[3].prompt.images["base_obj"]
    with_object = replace(
        frames, text=f"{{base_obj}} {frames.text}", images={"base_obj": alone, **frames.images}
    )
    told = []
    for prompt in (frames, with_object):
        batch, stack = Processor.of(network.config.inputs).encode_prompts([prompt])
        with torch.no_grad():
            features = network.encode_images(torch.from_numpy(stack.images()))
            scenes = network.encode_prompt(batch, features).scenes
            shown = network._shown(
                batch, batch.object_index_BL >= 0, features[batch.crop_index_VS], scenes.appearance_BKA[0]
            )
        told.append((scenes.numbers_BK, scenes.turns_BKR, shown.changes_SD[None]))
    for before, after in zip(*told, strict=True):
        torch.testing.assert_close(after[:, 1:], before)
    assert told[0][0].max() == len(frames.images) - 1


def test_motions_show_the_table(demos):
    processor = Processor("objects")
    examples, _ = examples_of(demos[:1], processor)
    motion = as_motion(preprocess(demos[0], "objects"))
    batch = collate_examples(processor, [replace(examples[0], episode=motion)])
    assert batch.prompts.in_scene_S.all()
    assert batch.prompts.image_index_S.max() == demos[0].num_steps


def test_an_episode_may_be_read_with_none_of_its_prompt_found(network, demos):
    demo = demos[3]
    processor = Processor.of(network.config.inputs)
    prompt = replace(demo.prompt, text="Rotate it 30 degrees.", images={})
    batch, stack = processor.encode_prompts([prompt])
    history, stack = processor.encode_observations([[demo.observation(0)]], stack=stack)
    features = network.encode_images(torch.from_numpy(stack.images()))
    memory = network.encode_prompt(batch, features)
    inputs = network(memory, history, features, torch.zeros(1, 1, 12))
    assert network.head.decide(inputs).isfinite().all()


def test_roles_do_not_follow_from_names_of_textures_and_looks_of_words_do(network, demos):
    prompt = demos[4].prompt
    first, rest = prompt.text.removeprefix("Put the ").split(" object in ", 1)
    memories = []
    for named in (first, *(("green", "purple") if first != "green" else ("purple", "green"))):
        named_prompt = replace(prompt, text=f"Put the {named} object in {rest}")
        batch, stack = Processor.of(network.config.inputs).encode_prompts([named_prompt])
        with torch.no_grad():
            features = network.encode_images(torch.from_numpy(stack.images()))
            memories.append(network.encode_prompt(batch, features))
    _, green, purple = memories
    torch.testing.assert_close(green.roles_BLD, purple.roles_BLD)
    assert (green.tokens_BLD - purple.tokens_BLD).abs().max() > 1e-3
    assert (green.word_looks_BLA - purple.word_looks_BLA).abs().amax(-1).nonzero().tolist() == [[0, 2]]
    names = [word for word in re.split(r"\W+", rest) if word_ids().get(word) in texture_word_ids()]
    assert green.word_looks_BLA.abs().amax(-1).count_nonzero() == 1 + len(names)  # no other word has a look


def test_words_of_textures_are_those_that_name_them_alone():
    words = {word for word, number in word_ids().items() if number in texture_word_ids()}
    assert {"blue", "stripe", "polka", "dot", "paisley", "tiles", "dark"} <= words
    assert not words & {"and", "object", "the", "texture", "wug", "kobar", "darker"}
