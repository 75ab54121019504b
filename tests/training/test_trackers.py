"""TensorBoard and Weights & Biases behind one interface."""

import io
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from openvima.errors import MissingExtraError
from openvima.training.config import TrainingConfig
from openvima.training.trackers import TensorBoardTracker, Tracker, WandbTracker, open_trackers
from openvima.video.encoder import Animation


@pytest.fixture
def animation() -> Animation:
    """Three frames of one shade each."""
    frames = np.stack([np.full((16, 32, 3), shade, np.uint8) for shade in (0, 100, 200)])
    return Animation("rotate", "solved (steps: 1)", np.full((8, 32, 3), 255, np.uint8), frames, 6)


def track(tracker: Tracker, animation: Animation) -> None:
    tracker.add("2-cloning", {"loss": 0.25}, 7)
    tracker.add_animations("2-cloning", [animation], 8)
    tracker.close()


def test_an_animation_is_a_gif_of_its_frames(animation: Animation) -> None:
    with Image.open(io.BytesIO(animation.gif())) as image:
        assert (image.n_frames, image.size, image.info["duration"]) == (3, (32, 16), 160)
        image.seek(1)
        assert image.convert("RGB").getpixel((0, 0)) == (100, 100, 100)


@pytest.mark.skipif(find_spec("tensorboard") is None, reason="tensorboard is not installed")
@pytest.mark.filterwarnings("ignore")  # of the reader, whose package is not ours
def test_tensorboard_has_numbers_prompts_and_rollouts(animation: Animation, tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    track(TensorBoardTracker(tmp_path, 1), animation)
    events = EventAccumulator(str(tmp_path / "tensorboard_log"))
    events.Reload()
    assert [(event.step, event.value) for event in events.Scalars("2-cloning/loss")] == [(7, 0.25)]
    (rollout,) = events.Images("2-cloning/rotate/rollout")
    assert (rollout.step, rollout.encoded_image_string) == (8, animation.gif())
    assert events.Images("2-cloning/rotate/prompt")[0].width == 32


def test_wandb_is_asked_for_by_project_and_continued_by_run_folder(
    animation: Animation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, logged = [], []
    wandb = ModuleType("wandb")
    session = SimpleNamespace(log=lambda values, step: logged.append((values, step)), finish=lambda: None)

    def init(**settings: object) -> SimpleNamespace:
        asked.append(settings)
        return session

    wandb.init, wandb.Image = init, lambda pixels: pixels.shape
    wandb.Video = lambda file, *, format, caption: (file.read()[:3], format, caption)
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    settings = {"data": tmp_path / "demos", "out": tmp_path, "runtime.tensorboard": False}
    config = TrainingConfig.of({**settings, "runtime.wandb": "robots"})
    for _ in range(2):
        track(*open_trackers(config, tmp_path, 1), animation)
    assert asked[0] == asked[1]
    assert (asked[0]["project"], asked[0]["dir"]) == ("robots", str(tmp_path / "wandb_log"))
    assert asked[0]["config"]["preset"] == "nano"
    assert logged[0] == ({"2-cloning/loss": 0.25}, 7)
    media = {
        "2-cloning/rotate/prompt": (8, 32, 3),
        "2-cloning/rotate/rollout": (b"GIF", "gif", "solved (steps: 1)"),
    }
    assert logged[1] == (media, 8)
    assert open_trackers(TrainingConfig.of(settings), tmp_path, 1) == []


def test_without_wandb_its_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingExtraError, match=r"runtime\.wandb is 'robots'.*openvima\[wandb\]"):
        WandbTracker(tmp_path, "robots", {})
