"""A network that cannot learn 32 demonstrations by heart cannot learn."""

from dataclasses import replace

import pytest

torch = pytest.importorskip("torch")

from openvima.data import Dataset, GenerateConfig, generate  # noqa: E402
from openvima.policies import preset  # noqa: E402
from openvima.policies.inputs import Reader  # noqa: E402
from openvima.policies.layers.conv_encoder import ConvConfig  # noqa: E402
from openvima.policies.network import build_network  # noqa: E402
from openvima.training import TrainingConfig  # noqa: E402
from openvima.training.dataset import read_examples  # noqa: E402
from openvima.training.stages import Cloning  # noqa: E402


def test_32_demonstrations_are_learnt_by_heart(tmp_path):
    folder = generate(
        GenerateConfig(out=tmp_path / "demos", tasks=("rotate", "visual_manipulation"), episodes=16)
    )
    sizes = preset("nano")
    sizes = replace(
        sizes,
        images=replace(sizes.images, crop=ConvConfig(8, 32), width=64, crop_dropout=0.0),
        prompt=replace(sizes.prompt, text=replace(sizes.prompt.text, num_layers=1)),
        trunk=replace(sizes.trunk, width=64, num_layers=1, dropout=0.0),
    )
    examples = read_examples(Dataset(folder), Reader.of(sizes.images), validation_share=0.0, seed=0)
    model = build_network(sizes, seed=0)
    config = TrainingConfig(data=folder, out=tmp_path, batch=32, spurious_probability=0.0)
    stage = Cloning(model, config, replace(examples, validation=examples.training))
    optimizer = torch.optim.AdamW(stage.parameters, lr=2e-3)
    for step in range(150):
        optimizer.zero_grad()
        stage.backward(step)
        optimizer.step()
    metrics = stage.validate()
    assert metrics["pick_accuracy"] > 0.99
    assert metrics["place_accuracy"] > 0.99
    assert metrics["yaw_accuracy"] > 0.99
    assert metrics["offset_error_m"] < 0.02
