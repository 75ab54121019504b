"""However a network is made to read a recording's steps, it gives the recorded predictions."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.policies.golden import (
    Arrays,
    Inputs,
    assert_close_to_golden,
    decode_step_by_step,
    encode_prompts,
    inputs_of,
    needs,
    query_of,
    read_histories,
    recording,
    targets_of,
    time_first,
    tiny_network,
    watched,
)

from naive_inputs import PromptInput, StepInput
from openvima.perception.objects import ObjectViews
from openvima.policies.nn.policy_network import PolicyNetwork

NAMES = ("vima_tiny", "gato_tiny", "flamingo_tiny", "gpt_tiny")


@pytest.fixture(scope="module", params=[pytest.param(name, marks=needs(name)) for name in NAMES])
def recorded(request: pytest.FixtureRequest) -> tuple[PolicyNetwork, Inputs, Arrays]:
    """A network, the inputs of its recording, and the recording."""
    network, arrays = tiny_network(request.param), recording(request.param)
    return network, inputs_of(network, arrays), arrays


@torch.inference_mode()
def decode_at_once(network: PolicyNetwork, inputs: Inputs) -> torch.Tensor:
    """Decode whole histories as in training; return the action queries, (B, T, D)."""
    prompt = encode_prompts(network, inputs.prompts)
    history, features = read_histories(network, inputs.histories)
    with watched(network) as calls:
        network.loss(prompt, history, features, targets_of(history, inputs.actions_BTC))
    return query_of(calls)


def longer_companion(inputs: Inputs) -> Inputs:
    """Put an episode between the two that is longer in prompt and history and sees more objects."""
    first, second = inputs.prompts
    prompt = PromptInput(
        np.concatenate([first.words, second.words]),
        np.concatenate(
            [first.entries, np.where(second.entries < 0, -1, second.entries + len(first.objects))]
        ),
        np.concatenate([first.parts, second.parts]),
        np.concatenate([first.mask, second.mask]),
        ObjectViews.concatenate([first.objects, second.objects]),
        np.concatenate([first.numbers, second.numbers]),
        np.concatenate([first.in_scene, second.in_scene]),
    )
    history = [*inputs.histories[0], *inputs.histories[1][:2]]
    if len(history[0].objects) > 1:  # whole frames are always one
        history = [with_objects_twice(step) for step in history]
    actions = torch.cat([inputs.actions_BTC, inputs.actions_BTC[:, :2]], dim=1)
    return Inputs(
        [first, prompt, second],
        [inputs.histories[0], history, inputs.histories[1]],
        actions[[0, 0, 1]],
    )


def with_objects_twice(step: StepInput) -> StepInput:
    objects = ObjectViews.concatenate([step.objects, step.objects])
    nowhere = np.zeros((len(objects), 2))
    return replace(step, objects=objects, positions=nowhere, grasps=nowhere)


def test_golden_steps_read_one_by_one_give_the_recorded_predictions(recorded):
    network, inputs, arrays = recorded
    with torch.inference_mode():
        queries = decode_step_by_step(network, encode_prompts(network, inputs.prompts), inputs)
    assert_close_to_golden(time_first(queries), arrays["out.pred_tokens"])


@pytest.mark.parametrize("row", [0, 1])
def test_golden_episodes_read_alone_give_the_recorded_predictions(recorded, row):
    network, inputs, arrays = recorded
    only = slice(row, row + 1)
    alone = Inputs(inputs.prompts[only], inputs.histories[only], inputs.actions_BTC[only])
    assert_close_to_golden(decode_at_once(network, alone)[0].numpy(), arrays["out.pred_tokens"][:, row])


def test_golden_padding_for_a_longer_episode_keeps_the_recorded_predictions(recorded):
    network, inputs, arrays = recorded
    steps = len(arrays["in.ee"])
    queries = decode_at_once(network, longer_companion(inputs))[[0, 2], :steps]
    assert_close_to_golden(time_first(queries), arrays["out.pred_tokens"])
