"""Demonstrations for PyTorch, and how batches reach the main process."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.utils.data import DataLoader, Subset  # noqa: E402

from openvima.data import Dataset  # noqa: E402
from openvima.data.torch_dataset import DemonstrationDataset, tensors_of  # noqa: E402


@pytest.fixture(name="demos")
def _dataset(demos: Path) -> Dataset:
    return Dataset(demos)


def test_a_plain_loader_pads_demonstrations_of_different_lengths(demos: Dataset) -> None:
    items = DemonstrationDataset(demos.path)
    batch = next(iter(DataLoader(items, batch_size=10)))
    steps = max(demo.num_steps for demo in demos)
    assert steps > min(demo.num_steps for demo in demos)
    assert batch["rgb_top"].shape == (10, steps + 1, 3, 128, 256)
    assert batch["pose1_rotation"].shape == (10, steps, 4)
    assert batch["mask"].sum(1).tolist() == [demo.num_steps for demo in demos]
    assert batch["prompt_mask"].sum(1).tolist() == [len(demo.prompt.images) for demo in demos]
    assert batch["prompt"] == [demo.prompt.text for demo in demos]
    row, demo = next((k, demo) for k, demo in enumerate(demos) if demo.num_steps < steps)
    last = demo.num_steps
    assert torch.equal(batch["segm_front"][row, : last + 1], torch.from_numpy(np.array(demo.segm["front"])))
    assert (batch["segm_front"][row, last + 1 :] == 255).all()
    assert batch["pose0_position"][row, 0].tolist() == pytest.approx(demo.actions[0].pose0_position)
    assert (batch["pick_ids"][row, last:] == -1).all() and not batch["pose0_position"][row, last:].any()
    for number, (name, image) in enumerate(demo.prompt.images.items()):
        assert batch["prompt_names"][row][number] == name
        assert (batch["prompt_rgb_top"][row, number].numpy() == image.rgb["top"]).all()


def test_items_are_demonstrations_by_number(demos: Dataset) -> None:
    items = DemonstrationDataset(demos, lambda demo: demo.seed)
    seeds = [demo.seed for demo in demos]
    assert [items[number] for number in (2, 0, -1)] == [seeds[2], seeds[0], seeds[-1]]
    with pytest.raises(IndexError, match="episode 10 of 10; count from 0 to 9"):
        items[10]
    copied = pickle.loads(pickle.dumps(DemonstrationDataset(demos)))
    assert torch.equal(copied[0]["rgb_top"], DemonstrationDataset(demos)[0]["rgb_top"])


def test_a_demonstration_without_steps_has_tensors_without_rows(demos: Dataset) -> None:
    demo = demos[0]
    start = {
        "rgb": {view: images[:1] for view, images in demo.rgb.items()},
        "segm": {view: images[:1] for view, images in demo.segm.items()},
    }
    item = tensors_of(replace(demo, actions=(), pick_ids=(), place_ids=(), joint_paths=(), **start))
    assert item["pose0_position"].shape == (0, 2)
    assert item["pose1_rotation"].shape == (0, 4)


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_workers_need_no_shared_memory(demos: Dataset) -> None:
    """Docker gives containers 64 MB of it; such a loader stood still for ever."""
    items = Subset(DemonstrationDataset(demos), range(3, 7))
    expected = next(iter(DataLoader(items, batch_size=4)))
    options = {"num_workers": 2, "multiprocessing_context": "fork", "timeout": 60}
    (batch,) = DataLoader(items, batch_size=4, **options)
    assert type(batch) is dict and batch.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(batch[name], value) and not batch[name].is_shared()
        else:
            assert batch[name] == value
