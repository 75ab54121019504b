"""Train, evaluate, visualise and convert the detector, which finds objects in pixels."""

import json
import shlex
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from openvima.cli.terminal import Json, Out, Report, progress_bar, refuse_existing
from openvima.errors import ConfigError
from openvima.policies.base import require_torch, torch_threads
from openvima.training.detector import DetectorTrainingConfig  # tyro reads its fields

if TYPE_CHECKING:
    from openvima.detector.frames import Frame, FrameSampler

Folder = Annotated[Positional[Path | None], arg(metavar="DETECTOR")]
Training = Annotated[DetectorTrainingConfig, arg(name="")]
LEVEL = "L3"  # with objects and textures that are not in the training set
FRAMES_PER_EPISODE = 2  # one time step in both views


def train(config: Training) -> None:
    """Train a detector on the segmentation of demonstrations, or go on with a run that was interrupted.

    Example: openvima detector train --data demos --out detector --runtime.threads 2
    """
    from openvima.training.detector import train_detector

    with progress_bar("training") as report:
        folder = train_detector(config, report)
    hint = f"`openvima detector evaluate {shlex.quote(str(folder))}` scores it on novel objects."
    print(hint, file=sys.stderr)
    print(folder)


def evaluate(
    detector: Folder = None,
    *,
    data: Path | None = None,
    level: str | None = None,
    frames: int = 400,
    held_out: float | None = None,
    seed: int = 0,
    device: str = "cpu",
    as_json: Json = False,
) -> None:
    """Evaluate a detector with class-agnostic COCO metrics.

    Example: openvima detector evaluate detector --level L3

    Args:
        detector: Run folder or checkpoint folder; by default the bundled detector.
        data: Folder of demonstrations; by default the oracle generates episodes of all tasks of the level.
        level: train, L1 to L8, instead of --data; by default L3, with novel objects and textures.
        frames: Number of images, rounded up to pairs of views.
        held_out: Use only the demonstrations of --data that a training with this validation fraction holds
            out, such as 0.02; by default all.
        seed: Seed of the image sampling; also the first seed of generated episodes.
        device: cpu or cuda.
        as_json: Print JSON instead of a table.
    """
    from openvima.detector import load_detector
    from openvima.detector.evaluation import evaluate_detector, require_pycocotools
    from openvima.detector.frames import held_out_frames

    require_pycocotools()  # fail early
    loaded = load_detector(detector, device=device)
    with (
        torch_threads(1),  # so that results are reproducible
        _frames(data, level, frames, held_out, seed) as sampler,
        progress_bar("evaluating") as bar,
    ):
        counted = _counted(held_out_frames(sampler, frames, seed=seed), frames, bar)
        result = evaluate_detector(lambda rgb: loaded.detect(rgb, ""), counted)
    if as_json:
        source = {"data": str(data), "held_out": held_out} if data else {"level": level or LEVEL}
        name = str(detector or "bundled")
        print(json.dumps({"detector": name, **source, "seed": seed, **asdict(result)}))
    else:
        print(f"{result.objects:,} objects in {result.frames:,} frames")
        print(f"{'':<8}{'AP':>8}{'AP50':>8}{'AP75':>8}{'recall':>8}")
        for name, metrics in (("boxes", result.boxes), ("masks", result.masks)):
            cells = (metrics.ap, metrics.ap50, metrics.ap75, metrics.recall)
            print(f"{name:<8}" + "".join(f"{cell:>8.3f}" for cell in cells))


def show(
    detector: Folder = None,
    *,
    out: Path = Path("detections.png"),
    data: Path | None = None,
    level: str | None = None,
    frames: int = 12,
    seed: int = 0,
) -> None:
    """Draw detections: masks, boxes and scores; ground-truth boxes are dashed.

    Example: openvima detector show detector --out detections.png

    Args:
        detector: Run folder or checkpoint folder; by default the bundled detector.
        out: PNG file to write.
        data: Folder of demonstrations; by default the oracle generates episodes of all tasks of the level.
        level: train, L1 to L8, instead of --data; by default L3, with novel objects and textures.
        frames: Number of images, rounded up to pairs of views.
        seed: Seed of the image sampling; also the first seed of generated episodes.
    """
    from openvima.detector import load_detector
    from openvima.detector.evaluation import draw_detections, save_grid
    from openvima.detector.frames import held_out_frames

    if out.suffix.lower() != ".png":
        raise ConfigError(f"--out is {str(out)!r}; give the name of a PNG file, ending in .png.")
    loaded = load_detector(detector)
    with torch_threads(1), _frames(data, level, frames, None, seed) as sampler:
        images = [
            draw_detections(frame, loaded.detect(frame.rgb, ""))
            for frame in held_out_frames(sampler, frames, seed=seed)
        ]
    save_grid(images, out)
    print(out)


def convert(
    source: Annotated[Positional[Path], arg(metavar="IN")],
    out: Out,
    *,
    force: bool = False,
) -> None:
    """Convert a Detectron2 checkpoint of Mask R-CNN with ResNet-50; nothing in the file is executed.

    Example: openvima detector convert mask_rcnn.pth published-detector

    Args:
        source: The .pth file.
        out: Folder to write to.
        force: Replace an existing checkpoint.
    """
    refuse_existing(out, force=force)
    require_torch("reading a detector")
    from openvima.detector.checkpoint import load_detectron2, save_network

    save_network(load_detectron2(source), out)
    print(out)


@contextmanager
def _frames(
    data: Path | None,
    level: str | None,
    frames: int,
    held_out: float | None,
    seed: int,
) -> "Iterator[FrameSampler]":
    """Frames of a folder, or of temporary demonstrations."""
    from openvima.data import Dataset, GenerateConfig, generate
    from openvima.detector.frames import FrameSampler

    problems = []
    if frames < 1:
        problems.append(f"frames is {frames}; it must be at least 1.")
    if held_out is not None and not 0 <= held_out <= 1:
        problems.append(f"held-out is {held_out:g}; it must be between 0 and 1.")
    if data is not None and level is not None:
        problems.append(f"both data and level are given ({data} and {level}); leave one of them out.")
    if data is None and held_out is not None:
        problems.append(f"held-out is {held_out:g}, but no data are given; add --data.")
    if seed < 0:
        problems.append(f"seed is {seed}; it must not be negative.")
    if problems:
        raise ConfigError(" ".join(problems))
    if data is not None:
        from openvima.training.detector.stage import split_episodes

        dataset = Dataset(data)
        episodes = None if held_out is None else split_episodes(dataset, held_out)[1]
        yield FrameSampler(dataset, episodes)
        return
    with tempfile.TemporaryDirectory() as folder:
        config = GenerateConfig(out=Path(folder, "demos"), level=level or LEVEL, start_seed=seed)
        episodes = -(-frames // (FRAMES_PER_EPISODE * len(config.resolved_tasks())))
        with progress_bar("demonstrations") as report:
            generate(replace(config, episodes=episodes), report)
        yield FrameSampler(Dataset(config.out))


def _counted(frames: "Iterable[Frame]", total: int, report: Report) -> "Iterator[Frame]":
    for number, frame in enumerate(frames):
        report(number, total, "")
        yield frame
    report(total, total, "")


COMMANDS = {"train": train, "evaluate": evaluate, "show": show, "convert": convert}
