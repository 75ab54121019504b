"""Small networks and inputs for tests of policies and training."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from openvima.data import Demonstration
from openvima.data.preprocessed import PreprocessedEpisode, number_images, preprocess
from openvima.env import TabletopEnv
from openvima.policies import load_policy, preset
from openvima.policies.batch import Batch
from openvima.policies.build import PolicyConfig, build_network, config_to_dict
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.image_encoders import ConvConfig
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.pointer.config import CorrespondenceConfig, PointerConfig, small
from openvima.policies.pointer.correspondence import ObjectFeatures
from openvima.policies.pointer.inputs import HeadInputs, ObjectSet, PointerPrompt
from openvima.policies.presets import PRESETS
from openvima.policies.processor import Processor
from openvima.scene import Action
from openvima.training import TrainingConfig, train
from openvima.training.batches import Example, ExampleSource


def narrow_small(width: int = 32, crop_width: int = 4) -> PointerConfig:
    """The preset small, narrower and shallower, without attributes."""
    sizes = small()
    text = replace(sizes.prompt.text, width=width, num_layers=1, num_heads=2, head_width=16, hidden_width=32)
    crop = ConvConfig(width=crop_width, output_width=4 * crop_width)
    return replace(
        sizes,
        images=replace(sizes.images, crop=crop, box_width=16, width=width),
        prompt=replace(sizes.prompt, text=text, image_width=width),
        decoder=replace(sizes.decoder, width=width, num_layers=1, num_self_heads=2, num_cross_heads=2),
        head=replace(sizes.head, hidden_width=32),
        correspondence=CorrespondenceConfig(hidden_width=32),
        attributes=None,
    )


def narrow(name: str, width: int = 64) -> PolicyConfig:
    """A preset that is narrower and shallower, with convolutions on crops."""
    sizes = preset(name)
    return replace(
        sizes,
        images=replace(sizes.images, crop=ConvConfig(width // 8, width // 2), width=width),
        prompt=replace(sizes.prompt, text=replace(sizes.prompt.text, num_layers=1)),
        decoder=replace(sizes.decoder, width=width, num_layers=1),
    )


def perturbed(config: str | PolicyConfig, std: float = 0.05, *, seed: int = 3) -> PolicyNetwork:
    """A network whose outputs depend visibly on everything; fresh heads start near zero.

    Args:
        config: Its sizes; or "small", narrower and shallower, or the name of another preset.
        std: Of the noise that is added to all parameters.
        seed: Of the fresh weights.
    """
    if isinstance(config, str):
        config = narrow_small() if config == "small" else preset(config)
    network = build_network(config, seed=seed).eval()
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(std * torch.randn(parameter.shape, generator=generator))
    return network


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Sums then do not depend on the number of cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def object_set(
    tokens_BKD: torch.Tensor,
    appearance_BKA: torch.Tensor,
    positions_BK2: torch.Tensor,
    rotation_bins: int = 0,
) -> ObjectSet:
    """Objects that all exist, each in an image of its own."""
    batch, count = tokens_BKD.shape[:2]
    return ObjectSet(
        tokens_BKD,
        torch.ones(batch, count, dtype=torch.bool),
        appearance_BKA,
        positions_BK2,
        torch.arange(count).expand(batch, count),
        tokens_BKD.new_zeros(batch, count, rotation_bins),
    )


def pointer_prompt(
    masked_BLD: torch.Tensor, appearance_BLA: torch.Tensor, object_mask_BL: torch.Tensor, objects: ObjectSet
) -> PointerPrompt:
    """An encoded prompt whose heads-only parts are given; no word describes anything."""
    batch, length, width = masked_BLD.shape[0], masked_BLD.shape[1], appearance_BLA.shape[-1]
    none = ObjectFeatures(
        masked_BLD.new_zeros(batch, 2, 0, 1),
        torch.zeros(batch, 2, 0, 4, dtype=torch.int64),
        torch.zeros(batch, 2, 0, dtype=torch.bool),
        masked_BLD.new_zeros(batch, 0, width),
        masked_BLD.new_zeros(batch, 0, 2),
        torch.zeros(batch, 0, dtype=torch.bool),
        torch.zeros(batch, 0, dtype=torch.int64),
    )
    return PointerPrompt(
        masked_BLD,
        masked_BLD,
        torch.ones(batch, length, dtype=torch.bool),
        object_mask_BL,
        appearance_BLA,
        torch.zeros_like(appearance_BLA),
        none,
        objects,
    )


def drawn_head_inputs(sizes: tuple[int, int, int, int, int, int], *, first: int, scene: int) -> HeadInputs:
    """Random inputs of a pointer's head in double precision: 3 episodes, some objects of the second hidden.

    Args:
        sizes: B, T, N, M, D, A.
        first: Number of objects of the first step.
        scene: Number of objects in scenes of the prompt.
    """
    B, T, N, M, D, A = sizes
    generator = torch.Generator().manual_seed(1)

    def drawn(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def appearance(*shape):
        return torch.nn.functional.normalize(drawn(*shape, A), dim=-1)

    def positions_of(*shape):
        low, size = torch.tensor([0.3, -0.4]), torch.tensor([0.4, 0.8])
        return low + size * torch.rand(*shape, 2, generator=generator).double()

    def objects(count):
        return object_set(drawn(B, count, D), appearance(B, count), positions_of(B, count), 72)

    positions, masks = positions_of(B, T, N), torch.ones(B, T, N, dtype=torch.bool)
    masks[1, :, 3] = False
    prompt, prompt_appearance, scenes = drawn(B, M, D), appearance(B, M), objects(scene)
    return HeadInputs(
        query_BTD=drawn(B, T, D),
        objects_BTND=drawn(B, T, N, D),
        masks_BTN=masks,
        appearance_BTNA=appearance(B, T, N),
        positions_BTN2=positions,
        grasps_BTN2=positions + 0.01,
        has_suction_BT=torch.tensor([[True, True], [False, False], [True, False]]),
        previous_BTC=drawn(B, T, 12) * (torch.arange(T) > 0)[:, None],
        steps_BT=torch.arange(T)[None],
        first_step=objects(first),
        prompt=pointer_prompt(prompt, prompt_appearance, torch.ones(B, M, dtype=torch.bool), scenes),
        rotations_BTNR=drawn(B, T, N, 72).softmax(dim=-1),
    )


IN_VIEW = ("objects_BTND", "appearance_BTNA", "positions_BTN2", "grasps_BTN2", "rotations_BTNR")


def in_order(inputs: HeadInputs, order: torch.Tensor) -> HeadInputs:
    """The same inputs with the objects in view in another order."""
    values = {name: getattr(inputs, name)[:, :, order] for name in (*IN_VIEW, "masks_BTN")}
    return replace(inputs, **values)


def with_prompt(inputs: HeadInputs, **changes) -> HeadInputs:
    """The same inputs with another prompt."""
    return replace(inputs, prompt=replace(inputs.prompt, **changes))


def stack_images(episodes: list[PreprocessedEpisode]) -> tuple[list[Example], torch.Tensor]:
    """Examples that share a stack of images, and the stack."""
    images = [episode.images for episode in episodes]
    bases = np.cumsum([0, *map(len, images)])[:-1].tolist()
    stack = np.concatenate([np.zeros_like(images[0][:1]), *images])
    return [Example(*pair) for pair in zip(episodes, bases, strict=True)], torch.from_numpy(stack)


def examples_of(demos: Iterable[Demonstration], processor: Processor):
    """The same of demonstrations."""
    return stack_images([preprocess(demo, processor.input_kind) for demo in demos])


def source_of(demos: Iterable[Demonstration], processor: Processor) -> ExampleSource:
    """The same as if they had been read from an object cache."""
    return source_of_episodes([preprocess(demo, processor.input_kind) for demo in demos])


def source_of_episodes(episodes: list[PreprocessedEpisode]) -> ExampleSource:
    """Preprocessed demonstrations as if they had been read from an object cache."""
    counts = np.array([len(episode.images) for episode in episodes])
    lengths = np.array([[episode.num_steps, len(episode.objects)] for episode in episodes])
    return ExampleSource(episodes, np.arange(len(episodes)), np.cumsum(counts) - counts, lengths)


def collate_examples(processor: Processor, examples: Iterable[Example]) -> Batch:
    """A batch whose images are numbered as in the examples' stack."""
    examples = list(examples)
    return processor.collate(number_images([e.episode for e in examples], [e.base for e in examples]))


def rngs_of(examples: list[Example], seed: int = 0) -> list[np.random.Generator]:
    """A generator for each example."""
    return [np.random.default_rng([seed, number]) for number in range(len(examples))]


def metrics_of(run: Path) -> list[dict]:
    """What a training has logged."""
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def assert_it_acts(run: str | Path) -> NetworkPolicy:
    """Load the policy of a run and let it act once."""
    policy, env = load_policy(str(run)), TabletopEnv("rotate")
    observation, _ = env.reset(seed=0)
    policy.reset([env.prompt])
    (action,) = policy.act([observation])
    Action.from_arrays(action)
    return policy


class Killed(BaseException):
    """Stands for a kill signal."""


def check_mixed_precision(network: torch.nn.Module, loss: Callable[[], torch.Tensor]) -> None:
    """A loss in mixed precision is nearly that in float32, and its gradients are finite."""
    with torch.autocast("cpu", torch.bfloat16):
        mixed = loss()
    torch.testing.assert_close(mixed.float(), loss(), rtol=0.05, atol=0.05)
    mixed.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


def train_until(config: TrainingConfig, step: int) -> None:
    """Train and be killed when so many steps have been begun; nothing is tidied up."""
    from openvima.training import loop, policy

    begun = 0

    class Trainer(loop.Trainer):
        def _step(self, *arguments):
            nonlocal begun
            begun += 1
            if begun > step:
                raise Killed
            return super()._step(*arguments)

    with pytest.MonkeyPatch.context() as patched, pytest.raises(Killed):
        patched.setattr(policy, "Trainer", Trainer)
        train(config)


TRAIN = """
import json, os, sys
from pathlib import Path
from openvima.policies import presets
from openvima.policies.build import config_from_dict
from openvima.training import TrainingConfig, train

sizes, settings = json.loads(sys.argv[1])
presets.PRESETS[settings["preset"]] = lambda: config_from_dict(sizes)
kill_at = settings.pop("kill_at", None)
settings["data"], settings["out"] = Path(settings["data"]), Path(settings["out"])

def report(done, total, note):
    print(note, flush=True)
    if done == kill_at:
        os._exit(9)

train(TrainingConfig.of(settings), report)
"""


def training_script(settings: Mapping[str, Any]) -> list[str]:
    """Arguments of a Python that trains, and prints notes; with "kill_at" it dies at that step."""
    plain = {name: str(value) if isinstance(value, Path) else value for name, value in settings.items()}
    sizes = config_to_dict(PRESETS[settings["preset"]]())
    return ["-c", TRAIN, json.dumps([sizes, plain])]
