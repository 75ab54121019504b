"""The network with the architecture's tiny golden weights, stage by stage.

Recordings differ between thread counts by up to 2e-5, hence the absolute tolerance of 1e-4.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors.torch import load_file  # noqa: E402

from openvima.policies.config import PolicyConfig  # noqa: E402
from openvima.policies.heads.base import ACTION_PARTS, from_unit_range, to_unit_range  # noqa: E402
from openvima.policies.heads.bins import BinsConfig, decode_bins, encode_bins  # noqa: E402
from openvima.policies.inputs import HistoryBatch, PromptBatch  # noqa: E402
from openvima.policies.layers.object_encoder import ObjectEncoderConfig  # noqa: E402
from openvima.policies.layers.prompt_encoder import PromptEncoderConfig  # noqa: E402
from openvima.policies.layers.text_encoder import TextEncoderConfig, relative_bucket  # noqa: E402
from openvima.policies.layers.trunk import DecoderConfig, position_ids  # noqa: E402
from openvima.policies.layers.vit import VitConfig  # noqa: E402
from openvima.policies.network import Memory, PolicyNetwork, build_network  # noqa: E402
from openvima.policies.published import from_published  # noqa: E402

FOLDER = Path(os.environ.get("OPENVIMA_GOLDEN", "../shared/golden")) / "model"
pytestmark = pytest.mark.skipif(
    not (FOLDER / "vima_tiny.npz").is_file(), reason=f"no golden data in {FOLDER}"
)
TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(FOLDER / "vima_tiny.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def model() -> PolicyNetwork:
    crop = VitConfig(width=96, num_layers=2, num_heads=24, output_width=96)
    text = TextEncoderConfig(width=768, num_layers=2, num_heads=12, head_width=8, hidden_width=64)
    config = PolicyConfig(
        images=ObjectEncoderConfig(crop, box_width=96, width=64),
        prompt=PromptEncoderConfig(text, image_width=768, vocabulary_size=256, tokenizer="t5"),
        trunk=DecoderConfig(width=64, num_layers=2, num_self_heads=4, num_cross_heads=2),
        head=BinsConfig(hidden_width=128),
        action_width=256,
    )
    network = build_network(config, seed=0)
    network.load_state_dict(from_published(load_file(FOLDER / "vima_tiny.safetensors")))
    return network.eval()


def tensor(array: np.ndarray):
    return torch.from_numpy(np.ascontiguousarray(array))


def both_views(golden: dict[str, np.ndarray], kind: str) -> tuple:
    """Crops, boxes and masks with a view axis before the objects; the shorter view is padded."""
    result = []
    for part in ("cropped_img", "bbox", "mask"):
        views = [golden[f"in.{kind}.{part}.{view}"] for view in ("front", "top")]
        axis = views[0].ndim - {"cropped_img": 4, "bbox": 2, "mask": 1}[part]
        size = max(view.shape[axis] for view in views)
        padded = []
        for view in views:
            pad = [(0, 0)] * view.ndim
            pad[axis] = (0, size - view.shape[axis])
            padded.append(np.pad(view, pad))
        result.append(np.stack(padded, axis=axis))
    return tuple(result)


def prompt_batch(golden: dict[str, np.ndarray]) -> tuple[PromptBatch, np.ndarray]:
    crops, boxes, masks = both_views(golden, "prompt")  # (entries, view, slot, …)
    entries, _, size = masks.shape
    counts = [golden[f"in.prompt.mask.{view}"].shape[1] for view in ("front", "top")]
    types, words = golden["in.prompt_types"], list(golden["in.words"])
    rows, entry = [], 0
    for row_types in types:
        places = []
        for kind in row_types:
            if kind == 0:
                places.append((words.pop(0), -1, True))
            elif kind == 1:
                for view in range(2):
                    places += [
                        (0, view * entries * size + entry * size + k, bool(masks[entry, view, k]))
                        for k in range(counts[view])
                    ]
                entry += 1
        rows.append(places)
    length = max(len(places) for places in rows)
    padded = np.array([places + [(0, -1, False)] * (length - len(places)) for places in rows])

    def by_view(array: np.ndarray) -> np.ndarray:  # (entries, view, slot, …) -> (view, entries · slot, …)
        return array.swapaxes(0, 1).reshape(2, entries * size, *array.shape[3:])

    crops = by_view(crops)
    batch = PromptBatch(
        words_BL=tensor(padded[..., 0]),
        images_BL=tensor(padded[..., 1]),
        mask_BL=tensor(padded[..., 2].astype(bool)),
        crops_VS=torch.arange(2 * entries * size).view(2, -1),
        boxes_VS4=tensor(by_view(boxes)),
        masks_VS=tensor(by_view(masks)),
    )
    return batch, crops


def history_batch(golden: dict[str, np.ndarray]) -> tuple[HistoryBatch, np.ndarray]:
    crops, boxes, masks = (
        array.swapaxes(0, 1) for array in both_views(golden, "obs")
    )  # (B, T, view, slot, …)
    batch, steps, _, size = masks.shape
    points = torch.zeros(batch, steps, size, 2, dtype=torch.float64)
    history = HistoryBatch(
        crops_BTVN=torch.arange(masks.size).view(masks.shape),
        boxes_BTVN4=tensor(boxes),
        masks_BTVN=tensor(masks),
        counts_BT=torch.full((batch, steps), size),
        positions_BTN2=points,
        grasps_BTN2=points,
        end_effector_BT=tensor(golden["in.ee"].T),
        steps_BT=torch.ones(batch, steps, dtype=torch.bool),
    )
    return history, crops


def past_actions(golden: dict[str, np.ndarray]):
    """Actions of the first two steps in metres, from their bins, padded by an unused third one."""
    bins = np.concatenate([golden[f"in.action_bins.{key}"] for key in ACTION_PARTS], axis=-1).swapaxes(0, 1)
    unit = decode_bins(tensor(bins), torch.float64)
    return from_unit_range(torch.cat([unit, torch.full_like(unit[:, :1], 0.5)], dim=1))


@torch.no_grad()
def encoded_prompt(model: PolicyNetwork, golden: dict[str, np.ndarray]) -> Memory:
    batch, crops = prompt_batch(golden)
    return model.encode_prompts(batch, model.encode_images(tensor(crops).flatten(0, 1)))


def assert_close(actual, expected: np.ndarray) -> None:
    np.testing.assert_allclose(actual.detach().numpy(), expected, rtol=0, atol=TOLERANCE)


def test_golden_crop_features(model, golden):
    assert_close(
        model.encode_images(tensor(golden["in.prompt.cropped_img.front"])), golden["prompt.vit.front"]
    )


def test_golden_relative_positions_fall_into_the_same_buckets(golden):
    buckets = relative_bucket(tensor(golden["table.t5_relative_position"]))
    np.testing.assert_array_equal(buckets.numpy(), golden["table.t5_bucket"])


def test_golden_bins_are_the_published_ones(golden):
    """Values above 1 go to the last bin here, to a bin that does not exist there."""
    value = tensor(golden["table.value"])
    bins = encode_bins(value[:, None].expand(-1, 12))
    for component, name, count in ((0, "bin_x", 50), (1, "bin_y", 100), (2, "bin_rot", 50)):
        expected = np.minimum(golden[f"table.{name}"], count - 1)
        np.testing.assert_array_equal(bins[:, component].numpy(), expected)


def test_golden_prompt_is_encoded_alike(model, golden):
    memory = encoded_prompt(model, golden)
    mask = golden["prompt.mask"]
    np.testing.assert_array_equal(memory.mask_BL.numpy(), mask)
    assert_close(memory.tokens_BLD[tensor(mask)], golden["prompt.tokens"].swapaxes(0, 1)[mask])


@torch.no_grad()
def test_golden_observations_become_the_same_tokens(model, golden):
    history, crops = history_batch(golden)
    tokens, mask, _ = model.observe(history, model.encode_images(tensor(crops)))
    np.testing.assert_array_equal(mask.numpy(), golden["obs.mask"].swapaxes(0, 1))
    assert_close(tokens, golden["obs.tokens"].swapaxes(0, 1))


@torch.no_grad()
def test_golden_actions_become_the_same_tokens(model, golden):
    assert_close(
        model.actions(to_unit_range(past_actions(golden)[:, :2]).float()),
        golden["action.tokens"].swapaxes(0, 1),
    )


def test_golden_positions_count_valid_places_only(golden):
    ids = position_ids(tensor(golden["seq.mask"]))
    np.testing.assert_array_equal(ids.numpy(), golden["seq.position_ids"])


@torch.no_grad()
def test_golden_decoder_gives_the_same_outputs(model, golden):
    memory, mask = encoded_prompt(model, golden), tensor(golden["seq.mask"])
    tokens = tensor(golden["seq.tokens"]).transpose(0, 1)
    outputs, _ = model.trunk.extend(model.begin(memory), tokens, mask)
    expected = golden["seq.block1_out"]
    expected = expected if expected.shape[0] == len(mask) else expected.swapaxes(0, 1)
    assert_close(outputs[mask], expected[golden["seq.mask"]])


@torch.no_grad()
def test_golden_predictions_and_bins_are_the_same(model, golden):
    """Masked places are left out of the sequence here and kept there; the predictions must not notice."""
    memory = encoded_prompt(model, golden)
    history, crops = history_batch(golden)
    features = model.encode_images(tensor(crops).flatten(0, 3))
    inputs = model(memory, history, features, past_actions(golden))
    assert_close(inputs.query_BTD, golden["out.pred_tokens"].swapaxes(0, 1))
    decided = to_unit_range(model.head.decide(replace(inputs)).double())
    for key, part in ACTION_PARTS.items():
        expected = golden[f"out.decoded.{key}"].swapaxes(0, 1)
        np.testing.assert_allclose(decided[..., part].numpy(), expected, rtol=0, atol=1e-6)
