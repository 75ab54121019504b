"""Videos and images of real episodes."""

import av
import numpy as np
import pytest
from PIL import Image

from openvima.env.tabletop import TabletopEnv
from openvima.evaluation import save_episode_image
from openvima.evaluation.recording import record_episode
from openvima.evaluation.rollout_policies import OracleRolloutPolicy
from openvima.sim.ur5 import HOME
from openvima.video.recorder import SceneRenderer


@pytest.fixture(scope="module")
def env():
    return TabletopEnv("rotate", level="L1", domain="eval", realtime=True)


def read(path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_video_contains_the_prompt_the_start_the_arm_and_the_end(env, tmp_path):
    outcome = record_episode(env, OracleRolloutPolicy(), 0, tmp_path / "video.mp4", title="rotate", enlarge=2)
    frames = read(tmp_path / "video.mp4")
    assert outcome.success
    assert 3 < len(frames) / 30 < 15
    rows, columns, _ = frames[0].shape
    assert columns == 512 and rows > 256 + 32
    top = rows - 32 - 256  # prompt above, one line below
    assert all(
        np.abs(frame[: top - 2].astype(int) - frames[0][: top - 2]).mean() < 2 for frame in frames[::10]
    )
    env.reset(seed=0)
    start = SceneRenderer(env, enlarge=2).draw(env.scene).astype(int)
    assert np.abs(frames[0][top : top + 256] - start).mean() < 4
    assert (
        np.abs(frames[-1][top : top + 256] - start).mean() > np.abs(frames[0][top : top + 256] - start).mean()
    )


def test_equal_episodes_give_equal_videos(env, tmp_path):
    for name in ("a.mp4", "b.mp4"):
        record_episode(env, OracleRolloutPolicy(), 1, tmp_path / name, with_prompt=False, enlarge=1)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_the_arm_is_drawn_only_when_asked(env):
    env.reset(seed=2)
    renderer = SceneRenderer(env, enlarge=1)
    bare, with_arm = renderer.draw(env.scene, joints=None), renderer.draw(env.scene, HOME)
    assert bare.shape == (128, 256, 3)
    assert np.array_equal(bare, np.moveaxis(env.reset(seed=2)[0]["rgb"]["front"], 0, -1))
    assert (bare != with_arm).any()


def test_the_image_of_an_episode_has_prompt_start_and_end(tmp_path):
    env = TabletopEnv("visual_manipulation")
    path = tmp_path / "new" / "look.png"
    outcome = save_episode_image(env, path, seed=0)
    image = np.asarray(Image.open(path)).astype(int)
    assert outcome.success
    width, middle = image.shape[1], image.shape[1] // 2
    start, end = image[-256:-12, 12 : middle - 6], image[-256:-12, middle + 6 : width - 12]
    assert start.shape == end.shape
    assert 0.5 < np.abs(start - end).mean() < 60
