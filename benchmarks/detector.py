"""Speed of the detector on one core: inference and training.

    python benchmarks/detector.py [--quick] [--detector FOLDER] [--preset NAME] [--rounds R] [--json FILE]

Frames come from oracle episodes, one time step of each. Inference is timed for both views of a time step: the
network alone, the same in batches of four time steps, and the full extractor with boxes matched across views
and crops. The cost of the mask head depends on the number of detections, so the bundled detector or another
trained one is used. Without one the weights are random, and there are no more detections than objects on
average. A training step includes augmentation, losses, gradients and the optimizer, but no reading of shards.
Times are CPU times of this process in alternating rounds; medians are reported.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch

from openvima.data.records import rollout_oracle
from openvima.detector import BUNDLED, detector_config, load_detector
from openvima.detector.detection import JOINT_PAIRS, DetectedObjects
from openvima.detector.frames import Frame, augment_frame, frame_of
from openvima.detector.network import FrameDetector, MaskRCNN
from openvima.env import TabletopEnv
from openvima.render.camera import VIEWS
from openvima.scene import BACKGROUND_ID, FIRST_OBJECT_ID
from openvima.tasks import list_tasks, task_spec
from openvima.training.detector import DetectorTrainingConfig
from openvima.training.detector.stage import DetectorLearner
from sim import circumstances

FIRST_SEED = 3_000_000
QUICK_TASKS = ("rotate", "visual_manipulation")
DEFAULTS = DetectorTrainingConfig(data=Path(), out=Path())  # of training


def observations_of(tasks: Sequence[str], episodes: int) -> list[dict[str, Any]]:
    """Return one observation of each episode, with its `ee`."""
    found = []
    for task in tasks:
        env = TabletopEnv(task, level=task_spec(task).levels[0])
        for number in range(episodes):
            demo = rollout_oracle(env, FIRST_SEED + number)
            found.append(demo.observation(number % demo.num_steps))
    return found


def frames_of(observation: dict[str, Any]) -> list[Frame]:
    """Return both frames of an observation, with their objects."""
    ids = range(FIRST_OBJECT_ID[("suction", "spatula")[observation["ee"]]], BACKGROUND_ID)
    return [frame_of(observation["rgb"][view], observation["segm"][view], ids) for view in VIEWS]


def detector_to_measure(folder: Path | None, preset: str, objects: int) -> tuple[FrameDetector, str]:
    """Return a detector and a name for its weights."""
    if folder is not None or (preset == "small" and BUNDLED.is_dir()):
        return load_detector(folder), "bundled" if folder is None else str(folder)
    torch.manual_seed(0)
    network = MaskRCNN(replace(detector_config(preset), score_threshold=0.0, max_detections=objects))
    return FrameDetector(network.eval()), f"random weights of {preset}"


def training_step(preset: str, frames: Sequence[Frame]) -> Callable[[], None]:
    """Return a function that runs one training step."""
    torch.manual_seed(0)
    network = MaskRCNN(detector_config(preset))
    learner = DetectorLearner(network, sampled=DEFAULTS.proposals_per_frame).train()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it
    optimizer = torch.optim.AdamW(learner.parameters(), lr=DEFAULTS.optimizer.learning_rate)
    rng, generator = np.random.default_rng(0), torch.Generator().manual_seed(0)
    chosen = [frames[number % len(frames)] for number in range(DEFAULTS.loader.batch_size)]

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        loss, _ = learner(([augment_frame(frame, rng) for frame in chosen], generator))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(learner.parameters(), DEFAULTS.optimizer.max_grad_norm)
        optimizer.step()

    return step


def seconds(work: Callable[[], object]) -> float:
    """CPU time of one call."""
    start = time.process_time()
    work()
    return time.process_time() - start


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Time everything in alternating rounds, after a warm-up round."""
    tasks = QUICK_TASKS if options.quick else list_tasks()
    observations = observations_of(tasks, 1 if options.quick else 2)
    frames = [frame for observation in observations for frame in frames_of(observation)]
    num_objects = statistics.mean(len(frame.boxes) for frame in frames)
    detector, name = detector_to_measure(options.detector, options.preset, round(num_objects))
    extractor, step = DetectedObjects(detector), training_step(options.preset, frames)
    times: dict[str, list[float]] = {"detect": [], "batch": [], "extract": [], "train": []}
    views = [observation["rgb"][view] for observation in observations for view in VIEWS]
    chunks = [views[first : first + 2 * JOINT_PAIRS] for first in range(0, len(views), 2 * JOINT_PAIRS)]
    for number in range(options.rounds + 1):
        detect, extract = [], []
        for observation in observations:
            pair = [observation["rgb"][view] for view in VIEWS]
            detect.append(seconds(lambda pair=pair: detector.detect_batch(pair)))
            extract.append(seconds(lambda observation=observation: extractor.in_observation(observation)))
        batch = [
            2 * seconds(lambda chunk=chunk: detector.detect_batch(chunk)) / len(chunk) for chunk in chunks
        ]
        train = seconds(step)
        if number:
            times["detect"] += detect
            times["batch"] += batch
            times["extract"] += extract
            times["train"].append(train)
    found = [len(detector.detect(frame.rgb, "").boxes) for frame in frames]
    return {
        "detector": name,
        "pairs": len(observations),
        "objects_per_frame": round(num_objects, 2),
        "detections_per_frame": round(statistics.mean(found), 2),
        "detect_ms_per_pair": summary(times["detect"], 1e3),
        f"detect_ms_per_pair_of_{JOINT_PAIRS}": summary(times["batch"], 1e3),
        "extract_objects_ms_per_pair": summary(times["extract"], 1e3),
        f"training_s_per_step_of_{DEFAULTS.loader.batch_size}_frames": summary(times["train"], 1.0),
    }


def summary(values: Sequence[float], scale: float) -> dict[str, float]:
    """Return median, 10th and 90th percentile."""
    low, middle, high = (round(float(q) * scale, 2) for q in np.percentile(values, (10, 50, 90)))
    return {"median": middle, "p10": low, "p90": high}


def main() -> None:
    """Measure, print, and write the numbers as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--quick", action="store_true", help="two time steps and one round, for a smoke test")
    parser.add_argument("--detector", type=Path, help="trained detector; by default the bundled one")
    parser.add_argument(
        "--preset", default="small", choices=("small", "resnet50"), help="size of the trained network"
    )
    parser.add_argument("--rounds", type=int, default=5, help="rounds after the warm-up")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    if options.quick:
        options.rounds = 1
    torch.set_num_threads(1)
    where = circumstances() | {"torch": torch.__version__, "threads": 1, "rounds": options.rounds}
    print(", ".join(f"{name}: {value}" for name, value in where.items()))
    results = measure(options)
    for name, value in results.items():
        shown = value
        if isinstance(value, dict):
            shown = f"{value['median']:.2f}   (80 % of them {value['p10']:.2f} to {value['p90']:.2f})"
        print(f"{name.replace('_', ' '):<36}{shown}")
    if options.json:
        options.json.write_text(json.dumps(results | where, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
