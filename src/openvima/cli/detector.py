"""Train, score and look at the detector, which finds objects in pixels instead of by the segmentation."""

import json
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from openvima.cli.progress import Report, progress_bar
from openvima.training.detector import DetectorTrainingConfig  # tyro reads its fields

if TYPE_CHECKING:
    from openvima.detector.frames import Frame, FrameSource
    from openvima.detector.scoring import DetectorScore, Precision

Json = Annotated[bool, tyro.conf.arg(name="json")]
Folder = Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="DETECTOR")]
Training = Annotated[DetectorTrainingConfig, tyro.conf.arg(name="")]
LEVEL = "L3"  # whose objects and textures training never shows
FRAMES_PER_EPISODE = 2  # one moment in both views


def train(config: Training) -> int:
    """Train a detector on the segmentation of demonstrations, or go on with a run that was interrupted.

    Example: openvima detector train --data demos --out detector --runtime.threads 2

    Returns:
        Exit status.
    """
    from openvima.training.detector import train_detector

    with progress_bar("training") as report:
        folder = train_detector(config, report)
    print(f"`openvima detector evaluate {folder}` scores it on novel objects.", file=sys.stderr)
    print(folder)
    return 0


def evaluate(
    detector: Folder = None,
    *,
    data: Path | None = None,
    level: str | None = None,
    frames: int = 400,
    held_out: float | None = None,
    prompt_share: float = 0.25,
    seed: int = 0,
    device: str = "cpu",
    as_json: Json = False,
) -> int:
    """Score a detector with COCO's metrics, whatever the kind of object.

    Example: openvima detector evaluate detector --level L3

    Args:
        detector: Run folder or checkpoint folder; by default the detector that comes with the package.
        data: Folder of demonstrations; without it the oracle plays episodes of all tasks of the level.
        level: train, L1, L2, L3 or L4, instead of --data; by default L3, whose objects and textures training
            never shows.
        frames: Images to look at, rounded up to pairs of views.
        held_out: Of --data, look at the demonstrations alone that a training with this validation share
            keeps aside, such as 0.02; by default at all.
        prompt_share: Share of the images that show a prompt instead of the table.
        seed: Decides which images; also the first seed to play.
        device: Where to compute: cpu or cuda.
        as_json: Print JSON instead of a table.

    Returns:
        Exit status.
    """
    from openvima.detector import load_detector
    from openvima.detector.frames import held_out_frames
    from openvima.detector.scoring import require_pycocotools, score_detector

    require_pycocotools()  # before what takes a while
    loaded = load_detector(detector, device=device)
    with (
        _one_thread(),
        _frames(data, level, frames, held_out, prompt_share, seed) as source,
        progress_bar("looking") as bar,
    ):
        shown = _counted(held_out_frames(source, frames, seed=seed), frames, bar)
        score = score_detector(lambda rgb: loaded.detect(rgb, ""), shown)
    if as_json:
        looked_at = {"data": str(data), "held_out": held_out} if data else {"level": level or LEVEL}
        looked_at |= {"prompt_share": prompt_share, "seed": seed}
        print(json.dumps({"detector": str(detector or "package"), **looked_at, **asdict(score)}))
    else:
        _print_score(score)
    return 0


def show(
    detector: Folder = None,
    *,
    out: Path = Path("detections.png"),
    data: Path | None = None,
    level: str | None = None,
    frames: int = 12,
    prompt_share: float = 0.25,
    score: float = 0.5,
    seed: int = 0,
) -> int:
    """Draw what a detector finds: masks and boxes with scores, and dashed boxes where objects are.

    Example: openvima detector show detector --out detections.png

    Args:
        detector: Run folder or checkpoint folder; by default the detector that comes with the package.
        out: PNG file to write.
        data: Folder of demonstrations; without it the oracle plays episodes of all tasks of the level.
        level: train, L1, L2, L3 or L4, instead of --data; by default L3, whose objects and textures training
            never shows.
        frames: Images to look at, rounded up to pairs of views.
        prompt_share: Share of the images that show a prompt instead of the table.
        score: What is less sure is left out.
        seed: Decides which images; also the first seed to play.

    Returns:
        Exit status.
    """
    from openvima.detector import load_detector
    from openvima.detector.frames import held_out_frames
    from openvima.detector.pictures import draw_detections, save_sheet
    from openvima.errors import ConfigError

    if out.suffix.lower() != ".png":
        raise ConfigError(f"--out is {str(out)!r}; a picture is a PNG file, give a name that ends in .png.")
    loaded = load_detector(detector)
    with _one_thread(), _frames(data, level, frames, None, prompt_share, seed) as source:
        shown = held_out_frames(source, frames, seed=seed)
        pictures = [draw_detections(frame, loaded.detect(frame.rgb, ""), score=score) for frame in shown]
    save_sheet(pictures, out)
    print(out)
    return 0


def convert(
    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN")],
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")],
    *,
    force: bool = False,
) -> int:
    """Convert weights of Detectron2's Mask R-CNN with ResNet-50; nothing in the file is executed.

    Example: openvima detector convert mask_rcnn.pth published-detector

    Args:
        source: The .pth file.
        out: Folder to write to.
        force: Replace a checkpoint that is there.

    Returns:
        Exit status.
    """
    from openvima.errors import ConfigError
    from openvima.policies.base import require_torch

    if out.exists() and not force:
        raise ConfigError(f"{out} exists; give another folder, or --force to replace the checkpoint in it.")
    require_torch("reading a detector")
    from openvima.detector.checkpoint import save_network
    from openvima.detector.detectron2 import load_detectron2

    save_network(load_detectron2(source), out)
    print(out)
    return 0


@contextmanager
def _frames(
    data: Path | None,
    level: str | None,
    frames: int,
    held_out: float | None,
    prompt_share: float,
    seed: int,
) -> "Iterator[FrameSource]":
    """Frames of a folder, or of demonstrations that are played for the purpose and deleted afterwards."""
    from openvima.data import Dataset
    from openvima.detector.frames import FrameSource
    from openvima.errors import ConfigError

    problems = []
    if frames < 1:
        problems.append(f"frames is {frames}; it must be at least 1.")
    for name, share in (("held-out", held_out), ("prompt-share", prompt_share)):
        if share is not None and not 0 <= share <= 1:
            problems.append(f"{name} is {share:g}; it must be between 0 and 1.")
    if data is not None and level is not None:
        problems.append(f"both data and level are given ({data} and {level}); leave one of them out.")
    if data is None and held_out is not None:
        problems.append(f"held-out is {held_out:g}, but no data are given; name the training's with --data.")
    if seed < 0:
        problems.append(f"seed is {seed}; it must not be negative.")
    if problems:
        raise ConfigError(" ".join(problems))
    if data is not None:
        from openvima.training.detector.split import split_episodes

        dataset = Dataset(data)
        episodes = None if held_out is None else split_episodes(dataset, held_out)[1]
        yield FrameSource(dataset, episodes, prompt_share=prompt_share)
        return
    with tempfile.TemporaryDirectory() as folder:
        _play(Path(folder, "played"), level or LEVEL, frames, seed)
        yield FrameSource(Dataset(Path(folder, "played")), prompt_share=prompt_share)


@contextmanager
def _one_thread() -> "Iterator[None]":
    """Find the same objects on every machine."""
    from openvima.policies.base import require_torch

    require_torch("a detector")
    from openvima.policies.devices import torch_threads

    with torch_threads(1):
        yield


def _play(folder: Path, level: str, frames: int, seed: int) -> None:
    """Let the oracle play as many episodes as there are moments to look at."""
    from openvima.cli.progress import generation_table
    from openvima.data import GenerateConfig, generate

    config = GenerateConfig(out=folder, level=level, start_seed=seed)
    episodes = -(-frames // (FRAMES_PER_EPISODE * len(config.resolved_tasks())))
    with generation_table() as report:
        generate(GenerateConfig(out=folder, level=level, start_seed=seed, episodes=episodes), report)


def _counted(shown: "Iterable[Frame]", total: int, report: Report) -> "Iterator[Frame]":
    for number, frame in enumerate(shown):
        report(number, total, "")
        yield frame
    report(total, total, "")


def _print_score(score: "DetectorScore") -> None:
    print(f"{score.objects:,} objects in {score.frames:,} frames; shares of 1")
    print(f"{'':<8}{'AP':>8}{'AP50':>8}{'AP75':>8}{'recall':>8}")
    for name, precision in (("boxes", score.boxes), ("masks", score.masks)):
        print(f"{name:<8}{_cells(precision)}")


def _cells(precision: "Precision") -> str:
    numbers = (precision.ap, precision.ap50, precision.ap75, precision.recall)
    return "".join(f"{number:>8.3f}" for number in numbers)


COMMANDS = {"train": train, "evaluate": evaluate, "show": show, "convert": convert}
