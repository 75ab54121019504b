"""Speed of inference and training of the policies, on one CPU core and on a GPU if available.

    python benchmarks/policy.py [--quick] [--decisions] [--gpu] [--rounds R] [--json FILE]

Weights are random and word ids are hashes; neither affects the time. Observations come from oracle rollouts.
The CPU benchmarks run in float32, as the original does; single steps of a preset are also measured in
float64, the default of `openvima evaluate`.

A step at history length 5 is the fifth of an episode, from images to action. It is compared with inference
without caches (prompt with T5-base, crops of the prompt and all steps, decoder over all steps), the same with
equal crops encoded once, and the original implementation (cached prompt and tokens, decoder over all steps).
Only the first one includes cropping. Alternatives run in alternating rounds; medians are reported. Times of a
single step are also given as CPU time, which is less sensitive to other load, and with the 90th percentile
over episodes and rounds. `--decisions` measures nothing else.

On a GPU training steps of 128 demonstrations and decisions of 1 to 256 episodes at once are measured;
`--gpu` measures nothing else. There matrix products are in bfloat16.
"""

import argparse
import json
import os
import statistics
import time
import zlib
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from openvima.data.preprocessed import number_images, preprocess
from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies import preset
from openvima.policies.batch import HistoryBatch
from openvima.policies.build import outline_network
from openvima.policies.inference import NetworkPolicy
from openvima.policies.nn.actions import ACTION_WIDTH
from openvima.policies.nn.policy_network import PolicyNetwork, StepInputs
from openvima.policies.processor import Processor
from openvima.policies.tokenizer import Tokenizer, WordTokenizer
from sim import circumstances

HISTORY = 5
NUM_ENVS = 8
ACTING_TASKS = ("sweep_without_touching", "rearrange_then_restore")  # of many steps
TRAINING_TASKS = (
    "visual_manipulation",
    "rotate",
    "follow_order",
    "novel_noun",
    "rearrange",
    "scene_understanding",
)
NUM_TRAJECTORIES = 12
FIRST_SEED = 2_000_000
DECIDING = ("nano", "small")  # presets, besides the largest, whose single decisions are timed
GPU_PRESETS = ("small", "vima-2m", "vima-20m", "vima-200m")
GPU_BATCH = 128
GPU_ENVS = (1, 8, 64, 256)
PEAK_SIZE = {"cpu": 2048, "cuda": 8192}  # of the square matrices whose product shows what the machine can do


class WordHash:
    """Numbers words without the files of T5, within the size of its vocabulary."""

    end_id = 1
    texture_ids = np.zeros(0, np.int64)

    def encode(self, text: str) -> list[int]:
        """Give each word a number that follows from its letters."""
        return [3 + zlib.crc32(word.encode()) % 32000 for word in text.split()]


class Decision:
    """The fifth decision of an episode, to be made in each way."""

    def __init__(self, policy: NetworkPolicy, episode: Demonstration) -> None:
        self._policy, self._network, self._episode = policy, policy.network, episode
        self._prompt, stack = policy.processor.encode_prompts([episode.prompt])
        observations = [episode.observation(t) for t in range(HISTORY)]
        self._history, stack = policy.processor.encode_observations([observations], stack=stack)
        self._images = torch.from_numpy(stack.images())
        self._actions = torch.full((1, HISTORY, ACTION_WIDTH), 0.3)
        with torch.inference_mode():
            self._features = self._network.encode_images(self._images)
            self._encoded = self._network.encode_prompt(self._prompt, self._features)

    def sizes(self) -> dict[str, int]:
        """Return how much there is to read."""
        crop_index, masks = self._history.crop_index_BTVN, self._history.masks_BTVN
        return {
            "prompt_places": self._prompt.word_ids_BL.shape[1],
            "prompt_crops": int(self._prompt.masks_VS.sum()),
            "crops_in_all_steps": int(masks.sum()),
            "different_ones": len(crop_index[masks].unique()),
        }

    def approach(self) -> None:
        """Begin the episode anew and make the decisions before it."""
        self._policy.reset([self._episode.prompt])
        for t in range(HISTORY - 1):
            self._policy.act([self._episode.observation(t)])

    def keeping(self) -> None:
        """Decide with keys, values and features kept; `approach` comes first."""
        self._policy.act([self._episode.observation(HISTORY - 1)])

    @torch.inference_mode()
    def anew(self, *, share: bool = False) -> None:
        """Decide from scratch; `share` encodes equal crops once."""
        prompt, history, images = self._prompt, self._history, self._images
        if not share:
            prompt_index, step_index = prompt.crop_index_VS, history.crop_index_BTVN
            images = images[torch.cat([prompt_index.flatten(), step_index.flatten()])]
            prompt_numbers, step_numbers = torch.arange(len(images)).split(
                [prompt_index.numel(), step_index.numel()]
            )
            prompt = replace(prompt, crop_index_VS=prompt_numbers.view_as(prompt_index))
            history = replace(history, crop_index_BTVN=step_numbers.view_as(step_index))
        features = self._network.encode_images(images)
        self._decode(self._network.encode_prompt(prompt, features), history, features)

    @torch.inference_mode()
    def decoder_anew(self) -> None:
        """Decide with prompt and tokens kept, but no keys and values."""
        self._network.encode_images(self._images[self._history.crop_index_BTVN[:, -1].flatten()])
        self._decode(self._encoded, self._history, self._features)

    def _decode(self, prompt: Any, history: HistoryBatch, features: torch.Tensor) -> None:
        state, has_previous = self._network.init_cache(prompt), torch.arange(HISTORY)[None] > 0
        self._network.decode_step(StepInputs(prompt, state, history, features, self._actions, has_previous))


class Training:
    """Steps of behaviour cloning on one batch of demonstrations, image encoder included.

    On a GPU it multiplies in bfloat16, with weights in float32.
    """

    def __init__(self, network: PolicyNetwork, demos: Sequence[Demonstration], device: str) -> None:
        self._network, self._device = network.to(device).train(), device
        processor = Processor(*network.config.inputs, tokenizer_of(network))
        episodes = number_images([preprocess(demo, processor.input_kind) for demo in demos])
        images = [episode.images for episode in episodes]
        self._batch = processor.collate(episodes).with_images(images).to(device)
        trained = [p for p in network.parameters() if p.requires_grad]
        self._optimizer = torch.optim.AdamW(trained, lr=1e-6, fused=True)
        with FlopCounterMode(display=False) as counter:
            self.step()
        self.tflop = counter.get_total_flops() / 1e12

    def step(self) -> None:
        """Forward, backward and update."""
        network = self._network
        half = torch.autocast("cuda", torch.bfloat16) if self._device == "cuda" else nullcontext()
        with half:
            features = network.encode_images(self._batch.images)
            prompt = network.encode_prompt(self._batch.prompts, features)
            loss, _ = network.loss(prompt, self._batch.history, features, self._batch.targets)
        loss.backward()
        self._optimizer.step()
        self._optimizer.zero_grad(set_to_none=True)


def random_network(name: str) -> PolicyNetwork:
    """Build a preset with random weights, without the costly orthogonal ones."""
    network = outline_network(preset(name))
    generator = torch.Generator().manual_seed(0)
    weights = {
        key: torch.randn(tensor.shape, generator=generator).mul_(0.02).add_(tensor.ndim == 1)
        for key, tensor in network.state_dict().items()
    }
    network.load_state_dict(weights, assign=True)
    return network


def tokenizer_of(network: PolicyNetwork) -> Tokenizer:
    """Return the benchmark's vocabulary for networks without T5, else a stand-in for that of T5."""
    return WordTokenizer() if network.config.prompt.tokenizer == "words" else WordHash()


def demonstrations(tasks: Sequence[str], count: int, *, min_steps: int) -> list[Demonstration]:
    """Let the oracle play episodes of the tasks in turn."""
    envs = [TabletopEnv(task) for task in tasks]
    found: list[Demonstration] = []
    seed = FIRST_SEED
    while len(found) < count:
        demo = rollout_oracle(envs[len(found) % len(envs)], seed)
        seed += 1
        if demo.num_steps >= min_steps:
            found.append(demo)
    return found


def seconds(work: Callable[[], object], device: str = "cpu") -> float:
    """Time one call."""
    if device == "cuda":
        torch.cuda.synchronize()
    start = time.perf_counter()
    work()
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - start


def in_turns(works: dict[str, Callable[[], float]], num_rounds: int) -> dict[str, float]:
    """Run works that time themselves in alternating rounds, after a round to warm up; return medians."""
    rounds = [{name: work() for name, work in works.items()} for _ in range(num_rounds + 1)][1:]
    return {name: statistics.median(times[name] for times in rounds) for name in works}


def measure_decision(policy: NetworkPolicy, episode: Demonstration, num_rounds: int) -> dict[str, float]:
    """Time the fifth decision in every way; return seconds and sizes."""
    decision = Decision(policy, episode)

    def keeping() -> float:
        decision.approach()
        return seconds(decision.keeping)

    works = {
        "keeping": keeping,
        "anew": lambda: seconds(decision.anew),
        "anew_sharing_crops": lambda: seconds(lambda: decision.anew(share=True)),
        "decoder_anew": lambda: seconds(decision.decoder_anew),
    }
    times = in_turns(works, num_rounds)
    return {f"{name}_s": round(value, 4) for name, value in times.items()} | decision.sizes()


def measure_single(
    name: str, episodes: Sequence[Demonstration], num_rounds: int, precisions: Sequence[torch.dtype]
) -> dict[str, dict[str, float]]:
    """Time the fifth decision of every episode, from observation to action; return milliseconds.

    Precisions take turns, decision by decision. The decisions before the fifth warm up.
    """
    network = random_network(name)
    policies = {
        str(dtype).removeprefix("torch."): NetworkPolicy(
            deepcopy(network), tokenizer=tokenizer_of(network), dtype=dtype
        )
        for dtype in precisions
    }
    decisions = [
        (precision, Decision(policy, episode))
        for episode in episodes
        for precision, policy in policies.items()
    ]
    times: dict[str, list[tuple[float, float]]] = {precision: [] for precision in policies}
    for _ in range(num_rounds):
        for precision, decision in decisions:
            decision.approach()
            start, start_process = time.perf_counter(), time.process_time()
            decision.keeping()
            taken = time.perf_counter() - start, time.process_time() - start_process
            times[precision].append(taken)
    return {precision: _milliseconds(taken) for precision, taken in times.items()}


def _milliseconds(taken: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Median and 90th percentile of pairs of wall time and process time."""
    median, high = (
        np.quantile(np.array(taken) * 1000, share, axis=0).round(2).tolist() for share in (0.5, 0.9)
    )
    return {
        "process_ms": median[1],
        "process_90th_percentile_ms": high[1],
        "wall_ms": median[0],
        "wall_90th_percentile_ms": high[0],
    }


def acting(policy: NetworkPolicy, group: Sequence[Demonstration]) -> float:
    """Time the first five decisions of some episodes together."""
    policy.reset([episode.prompt for episode in group])
    return sum(
        seconds(lambda t=t: policy.act([episode.observation(t) for episode in group]), policy.device.type)
        for t in range(HISTORY)
    )


def measure_batch(
    policy: NetworkPolicy, episodes: Sequence[Demonstration], num_rounds: int
) -> dict[str, float]:
    """Time the first five decisions of all episodes, one after the other and together."""
    works = {
        "singles": lambda: sum(acting(policy, [episode]) for episode in episodes),
        "batch": lambda: acting(policy, episodes),
    }
    times = in_turns(works, num_rounds)
    number = HISTORY * len(episodes)
    return {
        "batch8_cost_over_8_singles": round(times["batch"] / times["singles"], 3),
        "decisions_per_s": round(number / times["singles"], 2),
        "decisions_per_s_in_batches": round(number / times["batch"], 2),
    }


def measure_training(
    training: Training, num_demos: int, num_rounds: int, device: str = "cpu"
) -> dict[str, float]:
    """Time training steps and, in turns with them, the machine's matrix products."""
    precision = torch.float32 if device == "cpu" else torch.bfloat16
    size = PEAK_SIZE[device]
    matrix = torch.randn(size, size, dtype=precision, device=device)
    works = {
        "step": lambda: seconds(training.step, device),
        "product": lambda: seconds(lambda: matrix @ matrix, device),
    }
    times = in_turns(works, num_rounds)
    peak = 2 * size**3 / 1e12 / times["product"]
    return {
        "trajectories_per_s": round(num_demos / times["step"], 2),
        "tflop_per_step": round(training.tflop, 4),
        "peak_tflop_per_s": round(peak, 4),
        "share_of_peak": round(training.tflop / times["step"] / peak, 3),
    }


def measure_decisions(
    large: str | None, episodes: Sequence[Demonstration], num_rounds: int
) -> dict[str, dict[str, dict[str, float]]]:
    """Time single decisions of the own presets, and of a large one in float32."""
    result = {}
    for name in (*DECIDING, *([large] if large else [])):
        precisions = (torch.float32,) if name == large else (torch.float32, torch.float64)
        result[name] = measure_single(name, episodes, num_rounds, precisions)
        for precision, values in result[name].items():
            show(f"{name}, decision at history {HISTORY}", precision, values)
    return result


def measure(large: str, *, quick: bool, num_rounds: int) -> dict[str, Any]:
    """Measure everything; `large` is the preset of the ratios."""
    episodes = demonstrations(ACTING_TASKS, NUM_ENVS, min_steps=HISTORY - 1)
    decisions = measure_decisions(large, episodes, num_rounds)
    demos = demonstrations(TRAINING_TASKS, NUM_TRAJECTORIES, min_steps=1)
    trained = ("nano",) if quick else ("vima-2m", "vima-20m")
    acting: dict[str, dict[str, float]] = {}
    training: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(("nano", *trained, large)):
        network = random_network(name)
        if name in trained:
            training[name] = measure_training(Training(network, demos, "cpu"), len(demos), num_rounds)
            show(name, "training", training[name])
        policy = NetworkPolicy(network, tokenizer=tokenizer_of(network), dtype=torch.float32)
        acting[name] = measure_batch(policy, episodes, max(1, num_rounds - 1))
        if name == large:
            acting[name] |= measure_decision(policy, episodes[0], num_rounds)
        show(name, "acting", acting[name])
    return {**ratios(large, acting[large]), "decisions": decisions, "acting": acting, "training": training}


def ratios(name: str, times: dict[str, float]) -> dict[str, float]:
    """Return the ratios that are promised, by name."""
    title = f"decision_speedup_{name.split('-')[-1].upper()}_history{HISTORY}"
    keeping = times["keeping_s"]
    return {
        title: round(times["anew_s"] / keeping, 2),
        f"{title}_sharing_crops": round(times["anew_sharing_crops_s"] / keeping, 2),
        f"{title}_decoder_only": round(times["decoder_anew_s"] / keeping, 2),
        "batch8_cost_over_8_singles": times["batch8_cost_over_8_singles"],
    }


def measure_gpu(num_rounds: int) -> dict[str, Any]:
    """Measure training and acting on the GPU, in bfloat16."""
    demos = demonstrations(TRAINING_TASKS, GPU_BATCH, min_steps=1)
    episodes = demonstrations(ACTING_TASKS, NUM_ENVS, min_steps=HISTORY - 1)
    result: dict[str, Any] = {"device": torch.cuda.get_device_name()}
    for name in GPU_PRESETS:
        training = Training(random_network(name), demos, "cuda")
        values = measure_training(training, len(demos), num_rounds, "cuda")
        values["share_of_time_in_kernels"] = share_in_kernels(training)
        network = random_network(name)
        policy = NetworkPolicy(network, tokenizer=tokenizer_of(network), device="cuda", dtype=torch.bfloat16)
        result[name] = values | {"decisions_per_s": measure_acting(policy, episodes, num_rounds)}
        show(f"{name} on the GPU", "bfloat16", result[name])
    return result


def measure_acting(
    policy: NetworkPolicy, episodes: Sequence[Demonstration], num_rounds: int
) -> dict[str, float]:
    """Return decisions per second by the number of episodes at once."""
    groups = {str(count): [episodes[i % len(episodes)] for i in range(count)] for count in GPU_ENVS}
    works = {count: partial(acting, policy, group) for count, group in groups.items()}
    times = in_turns(works, num_rounds)
    return {count: round(HISTORY * len(groups[count]) / times[count], 1) for count in times}


def share_in_kernels(training: Training) -> float:
    """Return the share of the time of a training step in which the GPU computes; else it waits for Python."""
    training.step()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profiler:
        training.step()
        torch.cuda.synchronize()
    kernels = sum(event.self_device_time_total for event in profiler.key_averages()) / 1e6
    return round(kernels / seconds(training.step, "cuda"), 3)


def show(name: str, what: str, values: dict[str, float]) -> None:
    """Print one line of numbers."""
    print(f"{name}, {what}: " + ", ".join(f"{key} {value}" for key, value in values.items()), flush=True)


def main() -> None:
    """Measure, print, and write the numbers as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--quick", action="store_true", help="smaller presets, to try it out")
    parser.add_argument("--decisions", action="store_true", help="only decisions of nano and small")
    parser.add_argument("--gpu", action="store_true", help="only on a GPU")
    parser.add_argument(
        "--rounds", type=int, default=3, help="alternating rounds, after a first that warms up"
    )
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    torch.set_num_threads(1)
    where = circumstances() | {"torch": torch.__version__, "threads": 1, "rounds": options.rounds}
    print(", ".join(f"{name}: {value}" for name, value in where.items()))
    large = "vima-2m" if options.quick else "vima-200m"
    results: dict[str, Any] = {}
    if options.decisions:
        episodes = demonstrations(ACTING_TASKS, NUM_ENVS, min_steps=HISTORY - 1)
        results = {"decisions": measure_decisions(None, episodes, options.rounds)}
    elif not options.gpu:
        results = measure(large, quick=options.quick, num_rounds=options.rounds)
    if options.gpu or (torch.cuda.is_available() and not (options.quick or options.decisions)):
        results["gpu"] = measure_gpu(options.rounds)
    for key, value in results.items():
        if not isinstance(value, dict):
            print(f"{key}: {value}")
    if options.json:
        options.json.write_text(json.dumps(results | where, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
