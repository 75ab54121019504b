"""A Hub on this machine, the client of the Hub that talks to it, a checkpoint and a data set."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from local_hub import TOKEN, LocalHub, serving
from openvima.data.encoding import ShardInfo
from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from small_data_sets import with_plain_images, write_folder


@pytest.fixture(scope="package")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalHub]:
    """A Hub that huggingface_hub, imported anew, finds through its variables, with empty caches."""
    pytest.importorskip("huggingface_hub")
    with serving() as hub, pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_ENDPOINT", hub.endpoint)
        patch.setenv("HF_HOME", str(tmp_path_factory.mktemp("hf_home")))
        patch.setenv("HF_TOKEN", TOKEN)
        patch.setenv("HF_HUB_DISABLE_XET", "1")
        patch.setenv("HF_HUB_DISABLE_PROGRESS_BARS", "1")
        for name in ("HF_HUB_CACHE", "HF_ASSETS_CACHE", "HF_HUB_OFFLINE"):
            patch.delenv(name, raising=False)
        for name in [name for name in sys.modules if name.partition(".")[0] == "huggingface_hub"]:
            patch.delitem(sys.modules, name)
        yield hub
        for name in [name for name in sys.modules if name.partition(".")[0] == "huggingface_hub"]:
            del sys.modules[name]


@pytest.fixture
def hub(client: LocalHub, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LocalHub:
    """The Hub without repositories; the working folder is empty."""
    monkeypatch.chdir(tmp_path)
    client.repositories.clear()
    client.requests.clear()
    return client


@pytest.fixture(scope="package")
def demonstrations() -> list[Demonstration]:
    """Two demonstrations with images of one colour."""
    env = TabletopEnv("rotate", level="train", domain="user")
    return [with_plain_images(rollout_oracle(env, seed)) for seed in range(2)]


@pytest.fixture
def demos(demonstrations: list[Demonstration], tmp_path: Path) -> Path:
    """A finished data set of two licences."""
    info = ShardInfo("rotate", "train", "user", 0, 2, 0, "procedural", {"openvima": "0"})
    return write_folder(tmp_path / "demos", info, [demonstrations], licence="MIT AND CC-BY-4.0")
