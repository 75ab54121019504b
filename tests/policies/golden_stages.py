"""Every stage of a network, by its name in recordings and with their order of axes.

Shape suffixes: B batch, T steps, L positions, Q slots of a step, N slots of a view, V views, D width, C
components of an action.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.policies.golden import (
    Arrays,
    Calls,
    Inputs,
    decode_at_once,
    encode_prompts,
    inputs_of,
    only,
    predictions,
    query_of,
    read_histories,
    step_of,
    time_first,
    watched,
)

from naive_inputs import WORD, HistoryBatch, NaiveProcessor, StepInput, padded
from openvima.policies.nn.action_head import ObservationTokens, decode_bins, encode_bins
from openvima.policies.nn.actions import ACTION_PARTS, ACTION_WIDTH, to_unit_range
from openvima.policies.nn.decoder import Decoder, PrefixDecoder
from openvima.policies.nn.layers import Unpadder
from openvima.policies.nn.policy_network import NUM_END_EFFECTORS, EncodedPrompt, PolicyNetwork, StepInputs
from openvima.render.camera import VIEWS


@torch.inference_mode()
def stages(network: PolicyNetwork, recorded: Arrays) -> Arrays:
    """Compute what a recording has of its batch of two environments, from the first image to the actions."""
    inputs = inputs_of(network, recorded)
    with watched(network) as calls:
        prompt = encode_prompts(network, inputs.prompts)
    result = _prompt_stages(network, calls, prompt, inputs)
    result |= _prompt_image_stages(network, recorded, calls)

    history, features = read_histories(network, inputs.histories)
    with watched(network) as calls:
        observed = network.observe(history, features)
        query_BTD, decoded_BTC = decode_at_once(network, prompt, history, features, inputs.actions_BTC)
    actions_BTD = calls.outputs["head.actions"][0][:, 1:]  # none before the first step
    result |= _step_image_stages(network, recorded, calls)
    result["obs.tokens"] = _without_token_axis(time_first(observed.tokens_BTQD))
    result["obs.mask"] = time_first(observed.mask_BTQ)
    result["action.concat"] = time_first(calls.inputs["head.actions.out"][0][:, 1:])
    result["action.tokens"] = time_first(actions_BTD)

    tokens_BLD = _interleaved(observed.tokens_BTQD, actions_BTD)
    mask_BL = _interleaved(observed.mask_BTQ, torch.ones_like(observed.mask_BTQ[:, 1:, 0]))
    result |= _sequence_stages(network, prompt, tokens_BLD, mask_BL, inputs)
    predicted = predictions(network, query_BTD, decoded_BTC)
    return result | {f"out.{name}": value for name, value in predicted.items()}


@torch.inference_mode()
def closed_loop(network: PolicyNetwork, recorded: Arrays) -> Arrays:
    """Run the first environment with the network's own actions and a key-value cache.

    The published code pads steps of fewer objects with zero vectors, also earlier steps when it decodes them
    again, and acts from the last slot. So its second decoding of the first step, which has no effect, acts
    from a zero vector, and the third step does. The `pred_tokens` of a step hold all steps before it, decoded
    again in this way.
    """
    prompt = encode_prompts(network, inputs_of(network, recorded).prompts[:1])
    result = {"roll.prompt.tokens": time_first(prompt.tokens_BLD), "roll.prompt.mask": prompt.mask_BL.numpy()}
    state = network.init_cache(prompt)
    steps: list[StepInput] = []
    actions_B1C = [torch.zeros(1, 1, ACTION_WIDTH, dtype=torch.float64)]  # none before the first step
    for t, end_effector in enumerate(recorded["in.ee"][:, 0]):
        steps.append(step_of(recorded, f"roll.step{t}", (), int(end_effector)))
        history, features = read_histories(network, [steps[-1:]])
        observed = network.observe(history, features)

        filled, counts = _filled(steps)
        with _zero_vectors_beyond(network, counts[-1:]):
            batch = read_histories(network, [filled[-1:]])
            has_previous_B1 = torch.tensor([[t > 0]])
            with watched(network) as calls:
                action_B1C, state = network.decode_step(
                    StepInputs(prompt, state, *batch, actions_B1C[-1], has_previous_B1)
                )
        actions_B1C.append(action_B1C.double())
        unit_B1C = decode_bins(encode_bins(to_unit_range(actions_B1C[-1])), torch.float64)
        token = network.head.actions(unit_B1C.float())
        with _zero_vectors_beyond(network, counts):
            batch = read_histories(network, [filled])
            query_BTD, _ = decode_at_once(network, prompt, *batch, torch.cat(actions_B1C[1:], dim=1))

        step = predictions(network, query_of(calls), action_B1C)
        step |= {"obs_tokens": observed.tokens_BTQD[0, 0].numpy(), "action_token": token[0, 0].numpy()}
        step["pred_tokens"] = query_BTD[0].numpy()
        step["pred_token"] = query_of(calls)[0, 0].numpy()
        for key, part in ACTION_PARTS.items():
            step[f"env_action.{key}"] = action_B1C[0, 0, part].float().numpy()
        result |= {f"roll.step{t}.{name}": value for name, value in step.items()}
    return result


def _prompt_stages(network: PolicyNetwork, calls: Calls, prompt: EncodedPrompt, inputs: Inputs) -> Arrays:
    within_BL = _within_prompts(prompt, inputs)
    rows = zip(calls.outputs["prompt.words"][0], inputs.prompts, strict=True)
    words = [row[: len(of.words)][torch.from_numpy(of.entries == WORD)] for row, of in rows]
    result = {
        "prompt.word_emb": torch.cat(words).numpy(),
        "prompt.assembled": only(calls.inputs["prompt.text"][0].numpy(), within_BL),
        "prompt.t5_out": only(time_first(calls.outputs["prompt.text"][0]), within_BL.T),
        "prompt.tokens": only(time_first(prompt.tokens_BLD), within_BL.T),
        "prompt.mask": prompt.mask_BL.numpy(),
    }
    for block in range(len(network.prompt.text.blocks)):
        tokens_BLW = Unpadder(within_BL).pad(calls.outputs[f"prompt.text.blocks.{block}"][0])
        result[f"prompt.t5_block{block}"] = only(tokens_BLW.numpy(), within_BL)
    return result


def _prompt_image_stages(network: PolicyNetwork, recorded: Arrays, calls: Calls) -> Arrays:
    """Features of the images of prompts, and the tokens made of them; one row for each image."""
    frames, images = _images(recorded, "prompt")
    result = {}
    for name, view in zip(VIEWS, images, strict=True):
        result[f"prompt.vit.{name}"] = network.encode_images(torch.from_numpy(view)).numpy()
    entries = len(images[0])
    num_parts = NaiveProcessor.of(network.config.inputs).tokens_per_image if frames else len(VIEWS)
    counts = [1] * num_parts if frames else [view.shape[1] for view in images]

    def by_image(tokens_ID: torch.Tensor) -> np.ndarray:
        """Put the tokens of each image into one row: the slots of its first part, then of its second."""
        parts = tokens_ID.unflatten(0, (num_parts, entries, -1))
        rows = [part_END[:, :count] for part_END, count in zip(parts, counts, strict=True)]
        return _without_token_axis(torch.cat(rows, dim=1).numpy())

    result[f"prompt.{'img' if frames else 'obj'}_feat"] = by_image(calls.inputs["prompt.images"][0])
    result["prompt.obj_tokens"] = by_image(calls.outputs["prompt.images"][0])
    if not frames:
        for view, name in enumerate(VIEWS):
            boxes_END = calls.outputs[f"images.box_encoders.{view}"][0].unflatten(0, (entries, -1))
            result[f"prompt.bbox_feat.{name}"] = boxes_END[:, : counts[view]].numpy()
    return result


def _step_image_stages(network: PolicyNetwork, recorded: Arrays, calls: Calls) -> Arrays:
    """The same of observations; one row for each step of each environment."""
    frames, images = _images(recorded, "obs")
    tokens_TBQD = time_first(calls.inputs["observation_out"][0][..., :-NUM_END_EFFECTORS])
    result = {f"obs.{'img' if frames else 'obj'}_feat": _without_token_axis(_rows(tokens_TBQD))}
    for view, name in enumerate(VIEWS):
        result[f"obs.vit.{name}"] = _rows(network.encode_images(torch.from_numpy(images[view])).numpy())
        if not frames:
            boxes_BTND = calls.outputs[f"images.box_encoders.{view}"][0]
            result[f"obs.bbox_feat.{name}"] = _rows(time_first(boxes_BTND))
    return result


def _sequence_stages(
    network: PolicyNetwork,
    prompt: EncodedPrompt,
    tokens_BLD: torch.Tensor,
    mask_BL: torch.Tensor,
    inputs: Inputs,
) -> Arrays:
    """Decode the whole sequence with its masked positions, which the network itself leaves out."""
    decoder, known_BL = network.decoder, torch.ones_like(mask_BL)
    with watched(network) as calls:
        if isinstance(decoder, PrefixDecoder):
            separator_B1D = decoder.separator.expand(len(tokens_BLD), 1, -1)
            tokens_BLD = torch.cat([prompt.tokens_BLD, separator_B1D, tokens_BLD], dim=1)
            mask_BL = torch.cat([prompt.mask_BL, known_BL[:, :1], mask_BL], dim=1)
            known_BL = torch.cat([_within_prompts(prompt, inputs), known_BL[:, :1], known_BL], dim=1)
            before = decoder._empty_cache(tokens_BLD, mask_BL)
        else:
            before = network.init_cache(prompt)
        _, cache = decoder(before, tokens_BLD, mask_BL)
    mask = cache.mask_BS.numpy()
    result = {
        "seq.tokens": only(time_first(tokens_BLD), known_BL.T),
        "seq.mask": mask[:, None] if isinstance(decoder, PrefixDecoder) else mask,
        "seq.position_ids": calls.input("decoder.positions").numpy(),
    }
    for layer in range(len(decoder.self_blocks)):
        outputs_BLD = calls.output(f"decoder.self_blocks.{layer}").numpy()
        result[f"seq.block{layer}_out"] = only(outputs_BLD, known_BL)
    if isinstance(decoder, Decoder):
        result["seq.prompt_position_ids"] = calls.input("decoder.prompt_positions").numpy()
        for layer in range(len(decoder.cross_blocks)):
            result[f"seq.xattn{layer}_out"] = calls.output(f"decoder.cross_blocks.{layer}").numpy()
    return result


def _interleaved(slots: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """Put each action behind the slots of its step, tokens or masks; no action follows the last step."""
    pieces = [slots[:, 0]]
    for t in range(1, slots.shape[1]):
        pieces += [actions[:, t - 1, None], slots[:, t]]
    return torch.cat(pieces, dim=1)


def _within_prompts(prompt: EncodedPrompt, inputs: Inputs) -> torch.Tensor:
    """Which positions are within their prompt, (B, L); padding behind it has no meaning."""
    lengths = torch.tensor([len(of.words) for of in inputs.prompts])
    return torch.arange(prompt.mask_BL.shape[1]) < lengths[:, None]


def _images(recorded: Arrays, kind: str) -> tuple[bool, list[np.ndarray]]:
    """Return whether images are whole frames, and those of each view."""
    frames = f"in.{kind}.rgb.{VIEWS[0]}" in recorded
    return frames, [recorded[f"in.{kind}.{'rgb' if frames else 'cropped_img'}.{view}"] for view in VIEWS]


def _rows(values: np.ndarray) -> np.ndarray:
    """Join the axes of time and environments."""
    return values.reshape(-1, *values.shape[2:])


def _without_token_axis(values: np.ndarray) -> np.ndarray:
    """Drop the axis of tokens where an image has only one, as recordings have it."""
    return values.squeeze(-2) if values.shape[-2] == 1 else values


def _filled(steps: Sequence[StepInput]) -> tuple[list[StepInput], list[int]]:
    """Give all steps as many slots as the longest has; return also how many were their own."""
    counts = [len(step.objects) for step in steps]
    nowhere = np.zeros((max(counts), 2))
    filled = [
        replace(step, objects=padded(step.objects, max(counts)), positions=nowhere, grasps=nowhere)
        for step in steps
    ]
    return filled, counts


@contextmanager
def _zero_vectors_beyond(network: PolicyNetwork, counts: Sequence[int]) -> Iterator[None]:
    """Let the slots beyond each step's own be zero vectors, where the network encodes black crops."""
    observe = network.observe

    def observe_and_clear(history: HistoryBatch, features_KF: torch.Tensor) -> ObservationTokens:
        observed = observe(history, features_KF)
        own_TN = torch.arange(history.masks_BTVN.shape[-1]) < torch.tensor(counts)[:, None]
        own_TQ = own_TN.repeat(1, len(VIEWS))
        return replace(observed, tokens_BTQD=observed.tokens_BTQD * own_TQ[..., None])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network, "observe", observe_and_clear)
        yield
