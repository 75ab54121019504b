"""The command lines that faults are injected into: every verb that writes, in small."""

import contextlib
import importlib
import io
import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

from openvima.cli.main import VERBS, main

PACKAGE = Path(__file__).parents[1] / "src" / "openvima"
# What writes no file of its own, and why; a test compares it with the verbs that there are.
READ_ONLY = {
    "data push-to-hub": "sends files that are whole; nothing is written here",
    "policies list": "prints",
    "policies show": "prints",
    "policies push-to-hub": "sends files that are whole; nothing is written here",
    "assets info": "prints",
    "detector evaluate": "prints; its demonstrations are temporary",
    "serve": "answers",
}


@dataclass(frozen=True)
class Case:
    """A command line under faults.

    Args:
        words: What follows `openvima`; paths are relative to the folder that it runs in.
        inputs: Names of `INPUTS` that it reads.
        before: Command lines that make an output which it continues or replaces.
        setup: Makes it small, within the process.
        run: Function instead of the command line, of a verb that waits for people.
        parallel: The same command with worker processes.
        named: Words of which an error must contain one; by default the output.
        keeps: Whether files that are there stay until they are replaced.
        max_points: Points at most, of a command that takes long; 0 is no limit.
        timed: Names of files that hold times.
    """

    words: str
    inputs: tuple[str, ...] = ()
    before: tuple[str, ...] = ()
    setup: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext
    run: Callable[[], int] | None = None
    parallel: str = ""
    named: tuple[str, ...] = ("out",)
    keeps: bool = True
    max_points: int = 0
    timed: tuple[str, ...] = ()

    @property
    def verb(self) -> str:
        """The verb, such as "data merge"."""
        first, *rest = self.words.split()
        return f"{first} {rest[0]}" if first in SUBCOMMANDS else first

    def with_setup(self, more: Callable[[], AbstractContextManager[object]]) -> "Case":
        """Return the case with something around it."""

        @contextlib.contextmanager
        def both() -> Iterator[None]:
            with self.setup(), more():
                yield

        return replace(self, setup=both)


def _subcommands() -> dict[str, tuple[str, ...]]:
    found = {}
    for verb in VERBS:
        module = _module(verb)
        if commands := getattr(module, "COMMANDS", None):
            found[verb] = tuple(commands)
    return found


def _module(verb: str) -> ModuleType:
    return importlib.import_module(f"openvima.cli.{verb.replace('-', '_')}")


SUBCOMMANDS = _subcommands()


def all_verbs() -> list[str]:
    """Return the verbs of the command line, with their subcommands."""
    return [f"{verb} {sub}".strip() for verb in VERBS for sub in SUBCOMMANDS.get(verb, ("",))]


def import_everything(*, with_torch: bool = True) -> None:
    """Import what the verbs import, once for all processes that are forked.

    Args:
        with_torch: Also what networks need.
    """
    if not with_torch:
        for name in ("openvima.data", "openvima.cli.data", "openvima.cli.assets", "pyarrow.parquet"):
            importlib.import_module(name)
        return
    for file in sorted(PACKAGE.rglob("*.py")):
        if file.name != "__main__.py":
            parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
            with contextlib.suppress(ImportError):  # of an extra
                importlib.import_module(".".join(parts).removesuffix(".__init__"))
    for name in ("matplotlib.figure", "matplotlib.backends.backend_svg", "av", "pyarrow.parquet"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    import torch

    from openvima.data.records import rollout_oracle
    from openvima.env import TabletopEnv

    rollout_oracle(TabletopEnv("rotate", level="train"), 0)  # compiles
    torch.optim.AdamW([torch.zeros(1)])  # imports much of torch
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main(["generate", "--help"])


@contextlib.contextmanager
def _tiny_networks() -> Iterator[None]:
    """Presets of narrow networks."""
    import small_networks
    from openvima.detector import config as detectors
    from openvima.policies import presets
    from openvima.policies.nn.image_encoders import ConvConfig

    nano = presets.preset("nano")
    tiny = replace(
        nano,
        images=replace(nano.images, crop=ConvConfig(width=4, output_width=16), width=32),
        prompt=replace(nano.prompt, text=replace(nano.prompt.text, num_layers=1)),
        decoder=replace(nano.decoder, width=32, num_layers=1, num_self_heads=2, num_cross_heads=2),
    )
    detector = small_networks.one_level_detector()
    with (
        patch.dict(presets.PRESETS, {"tiny": lambda: tiny, "nano": lambda: tiny}),
        patch.dict(detectors.DETECTORS, {"small": lambda: detector}),
    ):
        yield


@contextlib.contextmanager
def _small_detector() -> Iterator[None]:
    """A file of Detectron2 that holds a narrow network; the published one has 170 MB."""
    import torch

    from openvima.detector import checkpoint
    from openvima.detector.config import DETECTORS
    from openvima.detector.network import MaskRCNN

    def load(source: Path) -> MaskRCNN:
        torch.manual_seed(0)
        return MaskRCNN(DETECTORS["small"]())

    with _tiny_networks(), patch.object(checkpoint, "load_detectron2", load):
        yield


@contextlib.contextmanager
def _small_gallery() -> Iterator[None]:
    """Thumbnails of one pixel."""
    import numpy as np

    from openvima.render import gallery

    with patch.object(gallery, "draw_thumbnail", lambda *_, **__: np.zeros((1, 1, 4), np.uint8)):
        yield


@contextlib.contextmanager
def _small_pack() -> Iterator[None]:
    """An original asset pack of two empty files, and a cache in the working folder."""
    from openvima.catalog import importing, pack_files

    empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
    hashes = dict.fromkeys(("kitting/object-template.urdf", "pallet/pallet.urdf"), empty)
    with (
        patch.object(importing, "known_hashes", lambda: hashes),
        patch.object(pack_files, "known_hashes", lambda: hashes),
        patch.dict(os.environ, {"OPENVIMA_CACHE": str(Path.cwd() / "out")}),
    ):
        yield


@contextlib.contextmanager
def _small_quickstart() -> Iterator[None]:
    """One task, one level, one baseline, a step of training and no videos."""
    from openvima import report, training
    from openvima.cli import quickstart
    from openvima.training import TrainingConfig

    def config(data: Path, out: Path, seed: int) -> TrainingConfig:
        small = {"schedule.steps": 1, "loader.batch_size": 2, "runtime.threads": 1, "pretraining.steps": 0}
        return TrainingConfig.of({"data": data, "out": out, "seed": seed, "preset": "tiny", **small})

    evaluate, no_videos = report.evaluate_and_report, report.VideoSelection(0)
    with (
        _tiny_networks(),
        patch.object(report, "evaluate_and_report", partial(evaluate, videos=no_videos)),
        patch.multiple(quickstart, TASKS=("rotate",), LEVELS=("L1",), BASELINES=("oracle",)),
        patch.object(training, "TrainingConfig", config),
    ):
        yield


def _damage() -> int:
    file = Path("demos/rotate-train-00000.arrow")
    file.write_bytes(file.read_bytes()[:-1000])
    return 0


def _make_checkout() -> int:
    folder = Path("checkout/vima_bench/tasks/assets")
    (folder / "textures").mkdir(parents=True)
    for name in ("kitting/object-template.urdf", "pallet/pallet.urdf"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).touch()
    return 0


def _make_published() -> int:
    from published_data import PUBLISHED, MadeEpisode, write_folder

    episodes = {f"rotate/00000{seed}": MadeEpisode(seed=seed) for seed in (1, 2)}
    write_folder(Path("published"), {name: made.files(PUBLISHED) for name, made in episodes.items()})
    return 0


def _record() -> int:
    """Do what `studio --record-demonstrations` does at the press of a button."""
    from openvima.data.records import rollout_oracle
    from openvima.data.user_demonstrations import record_demonstration
    from openvima.env import TabletopEnv
    from openvima.tasks import sample_episode

    demo = rollout_oracle(TabletopEnv("rotate", level="train", domain="user"), 1)
    record_demonstration("out", sample_episode("rotate", seed=1), demo.actions)
    return 0


_STUDY = """
from openvima.studies import Demonstrations, EvaluationSettings, Run, Study

def small(inputs):
    settings = {"preset": "tiny", "schedule.steps": 1, "loader.validation_fraction": 0.0}
    settings |= {"runtime.threads": 1, "loader.batch_size": 2, "pretraining.steps": 0}
    return Study("small", "Does it resume?", "fraction", (Run("all"),),
                 EvaluationSettings(("rotate",), ("L1",), 1), Demonstrations(("rotate",), 2), settings)
"""


def _make_study() -> int:
    Path("small_study.py").write_text(_STUDY)
    return 0


_TRAIN = (
    "--data demos --preset tiny --schedule.steps 2 --schedule.checkpoint-every 1 --loader.batch-size 2 "
    "--runtime.threads 1 --loader.validation-fraction 0 --pretraining.steps"
)
_DETECT = (
    "--data demos --schedule.steps 2 --schedule.checkpoint-every 1 --loader.batch-size 2 "
    "--runtime.device cpu --runtime.threads 1 --loader.validation-fraction 0.5 --loader.validation-frames 2"
)
_EVALUATE = "--policy oracle --tasks rotate --levels L1 --seed 1 --episodes 2"

INPUTS = {
    "demos": Case("generate --tasks rotate --episodes 2 --shard-size 1 --out demos"),
    "damaged": Case("damage", ("demos",), run=_damage),
    "others": Case("generate --tasks sweep_without_exceeding --episodes 2 --out others"),
    "cached": Case("data preprocess demos", ("demos",)),
    "run": Case(f"train {_TRAIN} 0 --out run", ("cached",), setup=_tiny_networks),
    "evaluation": Case(f"evaluate {_EVALUATE} --out evaluation"),
    "checkout": Case("checkout", run=_make_checkout),
    "published": Case("published", run=_make_published),
    "study": Case("study", run=_make_study),
}
CASES = (
    Case(
        "generate --tasks rotate --episodes 3 --shard-size 2 --out out",
        parallel="generate --tasks rotate --episodes 3 --shard-size 2 --out out --workers 2",
    ),
    Case(
        "generate --tasks rotate --episodes 3 --shard-size 2 --out out --keep-failed",
        before=("generate --tasks rotate --episodes 1 --shard-size 2 --out out --keep-failed",),
    ),
    Case("data info demos --html out.html --appearance out.json", ("demos",)),
    Case("data merge demos others out", ("demos", "others")),
    Case("data merge demos others out --force", ("demos", "others"), before=("data merge demos out",)),
    Case("data sample demos out --fraction 0.5", ("demos",)),
    Case("data split demos out --splits a=0.5,b=0.5", ("demos",)),
    Case("data import published out", ("published",)),
    Case(
        "data preprocess demos",
        ("demos",),
        parallel="data preprocess demos --workers 2",
        named=("object_cache",),
    ),
    Case("data export-lerobot demos out", ("demos",)),
    Case("assets gallery --out out", setup=_small_gallery),
    Case("assets import checkout", ("checkout",), setup=_small_pack),
    Case("tasks --gallery out"),
    Case("demo rotate --out out.mp4"),
    Case("demo rotate --seed 2 --out out.mp4", before=("demo rotate --seed 1 --out out.mp4",)),
    Case(f"train {_TRAIN} 0 --out out", ("cached",), setup=_tiny_networks),
    Case(
        f"train {_TRAIN} 0 --out out --force",
        ("cached",),
        setup=_tiny_networks,
        before=(f"train {_TRAIN} 0 --out out --seed 1",),
        keeps=False,
    ),
    Case("policies convert run out", ("run",), setup=_tiny_networks),
    Case(f"detector train {_DETECT} --out out", ("demos",), setup=_tiny_networks),
    Case("detector convert weights.pth out", setup=_small_detector),
    Case("detector show --data demos --frames 2 --out out.png", ("demos",)),
    Case(
        f"evaluate {_EVALUATE} --videos 1 --out out",
        parallel=f"evaluate {_EVALUATE} --videos 1 --out out --workers 2",
    ),
    Case("verify-results evaluation", ("evaluation",), named=("evaluation",)),
    Case("report evaluation --out out.html", ("evaluation",)),
    Case("report evaluation --out out.tex", ("evaluation",)),
    Case(
        "study small_study.py:small --episodes 1 --out out",
        ("study",),
        setup=_tiny_networks,
        max_points=40,
        timed=("cost.json", "study.json", "report.html"),
    ),
    Case("studio --record-demonstrations out", run=_record),
    Case(
        "quickstart --out out --demonstrations 2 --episodes 1 --workers 1",
        setup=_small_quickstart,
        max_points=10,
    ),
)
