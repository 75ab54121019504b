"""Golden recordings of the published networks: files, inputs, and what this package computes from them.

A recording is a file of arrays by name: inputs (`in.…`) and what the published code computed from them, with
two prompts and three steps of two environments. All sizes are read from the files.

Shape suffixes: B batch, T steps, D width, C components of an action.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import nn

from naive_inputs import (
    WORD,
    HistoryBatch,
    NaiveProcessor,
    PromptInput,
    StepInput,
    batch_histories,
    batch_prompts,
)
from openvima.perception.objects import ObjectViews, make_hidden_objects
from openvima.perception.preprocessing import ImageStack
from openvima.policies.build import outline_network
from openvima.policies.nn.action_head import BinsHead, decode_bins, shift_actions
from openvima.policies.nn.actions import ACTION_PARTS, ActionTargets, from_unit_range, to_unit_range
from openvima.policies.nn.policy_network import EncodedPrompt, PolicyNetwork, StepInputs
from openvima.policies.processor import Processor
from openvima.policies.published import config_from_published, from_published
from openvima.policies.tokenizer import PADDING_ID
from openvima.render.camera import VIEWS

FOLDER = Path(os.environ.get("OPENVIMA_GOLDEN", "../shared/golden")) / "model"
TOLERANCE = 1e-4
LARGE = 4.0  # magnitude of activations from which on the tolerance is relative
WORD_TYPE = 0  # of a piece of a prompt; an image is 1, and rows are filled up with -1

Arrays = dict[str, np.ndarray]


class Recording(Arrays):
    """The arrays of a recording by name, and which of them were read."""

    def __init__(self, arrays: Mapping[str, np.ndarray]) -> None:
        super().__init__(arrays)
        self.was_read: set[str] = set()

    def __getitem__(self, name: str) -> np.ndarray:
        self.was_read.add(name)
        return super().__getitem__(name)

    def unused_inputs(self) -> list[str]:
        """Return the names of inputs that nothing has read."""
        return [name for name in self if name.startswith("in.") and name not in self.was_read]


def needs(name: str) -> pytest.MarkDecorator:
    """Skip a test where the folder has no recording of that name."""
    return pytest.mark.skipif(not _file(name).is_file(), reason=f"no {name}.npz in {FOLDER}")


def recording(name: str) -> Recording:
    """Return the arrays of a recording by name."""
    with np.load(_file(name)) as arrays:
        return Recording(arrays)


def recorded_names(name: str) -> list[str]:
    """Return the names of all that was computed, so that a test can ask for each; none without the file."""
    if not _file(name).is_file():
        return []
    with np.load(_file(name)) as arrays:
        return [key for key in arrays.files if not key.startswith("in.")]


@cache
def described() -> dict:
    """Return what the folder says about its recordings."""
    return json.loads((FOLDER / "meta.json").read_text())


def tiny_network(name: str) -> PolicyNetwork:
    """Build a network from its weights in the folder."""
    return network_of(*tiny_weights(name))


def tiny_weights(name: str) -> tuple[dict[str, torch.Tensor], dict[str, int]]:
    """Return published weights and cfg of a tiny network; baselines take what they share from VIMA's."""
    about = described()[name]
    weights = load_file(FOLDER / f"{name}.safetensors")
    if shared := about.get("keys_shared_with_vima_tiny"):
        vima = load_file(FOLDER / "vima_tiny.safetensors")
        weights |= {key: vima[key] for key in shared}
    return weights, about["cfg"]


def network_of(weights: Mapping[str, torch.Tensor], cfg: Mapping[str, int]) -> PolicyNetwork:
    """Build a network from weights by their published names, in float32."""
    network = outline_network(config_from_published(weights, cfg))
    network.load_state_dict(from_published(weights), assign=True)
    return network.eval()


@dataclass(frozen=True, slots=True)
class Inputs:
    """A recording's inputs, as this package takes them.

    Args:
        prompts: One for each environment.
        histories: Their steps.
        actions_BTC: The actions taken, metres and quaternions; the last step's is made up, as none is known.
    """

    prompts: list[PromptInput]
    histories: list[list[StepInput]]
    actions_BTC: torch.Tensor


def inputs_of(network: PolicyNetwork, recorded: Arrays) -> Inputs:
    """Read the inputs of a recording."""
    steps, batch = recorded["in.ee"].shape
    histories = [
        [step_of(recorded, "obs", (t, b), int(recorded["in.ee"][t, b])) for t in range(steps)]
        for b in range(batch)
    ]
    bins = np.concatenate([recorded[f"in.action_bins.{key}"] for key in ACTION_PARTS], axis=-1)
    unit_BTC = decode_bins(torch.from_numpy(bins).transpose(0, 1), torch.float64)
    unit_BTC = torch.cat([unit_BTC, torch.full_like(unit_BTC[:, :1], 0.5)], dim=1)
    return Inputs(_prompts(network, recorded), histories, from_unit_range(unit_BTC))


def step_of(recorded: Arrays, kind: str, index: tuple[int, ...], end_effector: int) -> StepInput:
    """Read one observation."""
    objects, _ = _images(recorded, kind, index)
    nowhere = np.zeros((len(objects), 2))
    return StepInput(objects, nowhere, nowhere, end_effector)


def encode_prompts(network: PolicyNetwork, prompts: Sequence[PromptInput]) -> EncodedPrompt:
    """Encode prompts as a policy does."""
    stack = _stack(network)
    numbers = [stack.add(prompt.objects.crops) for prompt in prompts]
    return network.encode_prompt(batch_prompts(prompts, numbers), _features(network, stack))


def read_histories(
    network: PolicyNetwork, histories: Sequence[Sequence[StepInput]]
) -> tuple[HistoryBatch, torch.Tensor]:
    """Batch histories, and encode their images."""
    stack = _stack(network)
    numbers = [[stack.add(step.objects.crops) for step in history] for history in histories]
    return batch_histories(histories, numbers), _features(network, stack)


def targets_of(history: HistoryBatch, actions_BTC: torch.Tensor) -> ActionTargets:
    """Return actions as targets, without slots of objects."""
    no_slots_BT = torch.full_like(history.num_slots_BT, -1)
    return ActionTargets(actions_BTC, no_slots_BT, no_slots_BT, history.steps_BT)


def decode_at_once(
    network: PolicyNetwork,
    prompt: EncodedPrompt,
    history: HistoryBatch,
    features: torch.Tensor,
    actions_BTC: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Decode whole histories in one call; return the action queries, (B, T, D), and the actions."""
    previous = shift_actions(targets_of(history, actions_BTC))
    with watched(network) as calls:
        decoded_BTC, _ = network.decode_step(
            StepInputs(prompt, network.init_cache(prompt), history, features, *previous)
        )
    return query_of(calls), decoded_BTC


def decode_step_by_step(network: PolicyNetwork, prompt: EncodedPrompt, inputs: Inputs) -> torch.Tensor:
    """Decode one step at a time with a key-value cache; return the action queries, (B, T, D)."""
    state = network.init_cache(prompt)
    with watched(network) as calls:
        for t in range(len(inputs.histories[0])):
            history, features = read_histories(network, [steps[t : t + 1] for steps in inputs.histories])
            previous_B1C = inputs.actions_BTC[:, max(t - 1, 0), None]
            has_previous_B1 = torch.full(previous_B1C.shape[:2], t > 0)
            step = StepInputs(prompt, state, history, features, previous_B1C, has_previous_B1)
            _, state = network.decode_step(step)
    return query_of(calls)


def predictions(network: PolicyNetwork, query_BTD: torch.Tensor, actions_BTC: torch.Tensor) -> Arrays:
    """Return `pred_tokens`, and logits, bins and decoded values of each part, time first."""
    head = network.head
    assert isinstance(head, BinsHead)
    logits = head.logits(query_BTD)
    bins_BTC = torch.stack([of_component.argmax(-1) for of_component in logits], dim=-1)
    unit_BTC = to_unit_range(actions_BTC.double())
    result = {"pred_tokens": time_first(query_BTD)}
    for key, part in ACTION_PARTS.items():
        result[f"logits.{key}"] = time_first(torch.cat(logits[part], dim=-1))
        result[f"bins.{key}"] = time_first(bins_BTC[..., part])
        result[f"decoded.{key}"] = time_first(unit_BTC[..., part].float())
    return result


def time_first(tensor: torch.Tensor) -> np.ndarray:
    """Swap the first two axes, as recordings have it."""
    return tensor.transpose(0, 1).numpy()


def only(values: np.ndarray, where: torch.Tensor) -> np.ma.MaskedArray:
    """Mark the places where values mean something; `where` has the leading axes of the values."""
    hidden = ~where.numpy().reshape(*where.shape, *[1] * (values.ndim - where.ndim))
    return np.ma.array(values, mask=np.broadcast_to(hidden, values.shape))


def assert_close_to_golden(actual: np.ndarray, expected: np.ndarray, tolerance: float = TOLERANCE) -> None:
    """Compare shapes, dtypes and values; integers and booleans exactly, floats up to float32 rounding.

    Rounding errors grow with the values that are summed and depend on the order of summation, which differs
    between CPUs. Two runs of the published code that sum in another order differ by up to 2e-5, and by up to
    2.6e-4 inside VIMA-Flamingo, whose activations reach 64. So the absolute tolerance scales with the largest
    expected value where that exceeds `LARGE`.
    """
    assert actual.shape == expected.shape
    assert actual.dtype == expected.dtype
    if isinstance(actual, np.ma.MaskedArray):
        actual, expected = actual.compressed(), expected[~np.ma.getmaskarray(actual)]
    assert actual.size
    if expected.dtype.kind == "f":
        atol = tolerance * max(1.0, float(np.abs(expected).max()) / LARGE)
        np.testing.assert_allclose(actual, expected, rtol=0, atol=atol)
    else:
        np.testing.assert_array_equal(actual, expected)


@dataclass(frozen=True, slots=True)
class Calls:
    """First argument and first result of every call of every module, by the module's name."""

    inputs: dict[str, list[torch.Tensor]] = field(default_factory=dict)
    outputs: dict[str, list[torch.Tensor]] = field(default_factory=dict)

    def input(self, name: str) -> torch.Tensor:
        """Return the inputs of a module; several calls are concatenated along the second axis."""
        return torch.cat(self.inputs[name], dim=1)

    def output(self, name: str) -> torch.Tensor:
        """Return the outputs of a module; several calls are concatenated along the second axis."""
        return torch.cat(self.outputs[name], dim=1)


@contextmanager
def watched(network: nn.Module) -> Iterator[Calls]:
    """Record inputs and outputs of all modules of a network."""
    calls = Calls()

    def note(name: str, _: nn.Module, arguments: tuple, result: torch.Tensor | tuple) -> None:
        calls.inputs.setdefault(name, []).append(arguments[0])
        calls.outputs.setdefault(name, []).append(result[0] if isinstance(result, tuple) else result)

    hooks = [module.register_forward_hook(partial(note, name)) for name, module in network.named_modules()]
    try:
        yield calls
    finally:
        for hook in hooks:
            hook.remove()


def query_of(calls: Calls) -> torch.Tensor:
    """Return the decoder's outputs at the action queries, from which all components are classified."""
    return calls.input("head.classifiers.0")


def _file(name: str) -> Path:
    return FOLDER / f"{name}.npz"


def _stack(network: PolicyNetwork) -> ImageStack:
    return ImageStack(Processor(*network.config.inputs).input_kind)


def _features(network: PolicyNetwork, stack: ImageStack) -> torch.Tensor:
    return network.encode_images(torch.from_numpy(stack.images()))


def _prompts(network: PolicyNetwork, recorded: Arrays) -> list[PromptInput]:
    """Words and images of all prompts follow each other in reading order."""
    all_words, number, prompts = iter(recorded["in.words"]), 0, []
    for types in recorded["in.prompt_types"]:
        images: list[ObjectViews] = []
        places: list[tuple[int, int, int, bool]] = []  # word, entry, part, counts
        for piece in types[types >= 0]:
            if piece == WORD_TYPE:
                places.append((int(next(all_words)), WORD, 0, True))
                continue
            first = sum(len(image) for image in images)
            objects, counts = _images(recorded, "prompt", (number,))
            images.append(objects)
            number += 1
            places += [
                (PADDING_ID, first + slot, part, valid)
                for slot, part, valid in _places(network, objects, counts)
            ]
        words, entries, parts, mask = (np.array(column) for column in zip(*places, strict=True))
        numbers = np.repeat(np.arange(len(images)), [len(image) for image in images])
        objects, in_scene = ObjectViews.concatenate(images), np.zeros(len(numbers), dtype=bool)
        prompts.append(PromptInput(words, entries, parts, mask, objects, numbers, in_scene))
    return prompts


def _places(
    network: PolicyNetwork, objects: ObjectViews, counts: Sequence[int]
) -> list[tuple[int, int, bool]]:
    """Slot, part and validity of the tokens of one image."""
    processor = NaiveProcessor.of(network.config.inputs)
    if processor.layout == "frames":
        return [(0, part, True) for part in range(processor.tokens_per_image)]
    return [
        (k, view, bool(objects.masks[view, k])) for view, count in enumerate(counts) for k in range(count)
    ]


def _images(recorded: Arrays, kind: str, index: tuple[int, ...]) -> tuple[ObjectViews, list[int]]:
    """Return the objects, or the frames, at an index, and how many slots each view has.

    Views may have different numbers of slots; the shorter one is filled up, as both are equal here.
    """
    if f"in.{kind}.rgb.{VIEWS[0]}" in recorded:
        frames = np.stack([recorded[f"in.{kind}.rgb.{view}"][index] for view in VIEWS])[:, None]
        whole = make_hidden_objects(1)
        return ObjectViews(whole.ids, frames, whole.boxes, ~whole.masks, whole.grasps), [1, 1]
    masks = [recorded[f"in.{kind}.mask.{view}"][index] for view in VIEWS]
    objects = make_hidden_objects(max(len(mask) for mask in masks))
    for view, name in enumerate(VIEWS):
        count = len(masks[view])
        objects.crops[view, :count] = recorded[f"in.{kind}.cropped_img.{name}"][index]
        objects.boxes[view, :count] = recorded[f"in.{kind}.bbox.{name}"][index]
        objects.masks[view, :count] = masks[view]
    return objects, [len(mask) for mask in masks]
