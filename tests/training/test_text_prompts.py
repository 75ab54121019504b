"""Networks train on data with text prompts, whose prompts have no images at all."""

import pytest

from openvima.data import GenerateConfig, generate
from openvima.env import EnvConfig

pytest.importorskip("torch")

from openvima.evaluation import score
from openvima.policies import load_policy
from openvima.training import TrainingConfig, train


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::openvima.errors.UnknownWordWarning")  # textures beyond these few
@pytest.mark.parametrize("prompts", ["text", "mixed"])
def test_a_network_learns_from_text_and_is_scored_on_it(settings: dict, tmp_path, prompts: str) -> None:
    config = GenerateConfig(
        out=tmp_path / "demos", tasks=("rotate",), episodes=6, env_config=EnvConfig(prompts=prompts)
    )
    changes = {"data": generate(config), "pretraining.steps": 0, "schedule.steps": 2, "loader.batch_size": 2}
    run = train(TrainingConfig.of({**settings, **changes}))
    results = score(
        {"mine": load_policy(str(run))}, tasks=("rotate",), levels=("L1",), episodes=1, prompts=prompts
    )
    assert results.config["prompts"] == prompts
