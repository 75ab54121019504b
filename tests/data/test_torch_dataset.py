"""Demonstrations for PyTorch: the same batches for any number of workers, and a position that lasts."""

import json
import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from torch.utils.data import DataLoader  # noqa: E402

from openvima.data import Dataset, GenerateConfig, generate, torch_batches  # noqa: E402
from openvima.data.batching import BatchOrder  # noqa: E402
from openvima.data.object_cache.cache import open_object_cache  # noqa: E402
from openvima.data.torch_dataset import BatchLoader, DemonstrationDataset, collate, tensors_of  # noqa: E402
from openvima.errors import ConfigError, ShapeError  # noqa: E402


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("torch") / "demos"
    tasks = ("rotate", "manipulate_old_neighbor")
    return Dataset(generate(GenerateConfig(out=out, tasks=tasks, episodes=4)))


class Numbers(Sequence):
    """Episodes that are just numbers."""

    def __init__(self, count: int) -> None:
        self._count = count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index):
        return index


def total(episodes: list[int], number: int) -> torch.Tensor:
    return torch.tensor(sum(episodes))


def numbered(episodes: list[int], number: int) -> tuple[int, list[int]]:
    return number, episodes


def test_a_demonstration_becomes_tensors(demos: Dataset) -> None:
    items, demo = DemonstrationDataset(demos), demos[5]
    item = items[5]
    assert len(items) == 8
    assert item["rgb_top"].shape == (demo.num_steps + 1, 3, 128, 256)
    assert torch.equal(item["segm_front"], torch.from_numpy(np.array(demo.segm["front"])))
    assert item["pose1_rotation"].shape == (demo.num_steps, 4)
    assert item["pose0_position"][0].tolist() == pytest.approx(demo.actions[0].pose0_position)
    assert item["prompt"] == demo.prompt.text
    assert set(item["prompt_images"]) == set(demo.prompt.images)
    assert item["prompt_images"][next(iter(demo.prompt.images))]["rgb_front"].shape == (3, 128, 256)
    assert DemonstrationDataset(demos, lambda demo: demo.seed)[5] == demo.seed


@pytest.mark.parametrize("workers", [0, 1])
def test_a_plain_loader_pads_demonstrations_of_different_lengths(demos: Dataset, workers: int) -> None:
    items = DemonstrationDataset(demos.path)
    batch = next(iter(DataLoader(items, batch_size=8, num_workers=workers)))
    steps = max(demo.num_steps for demo in demos)
    assert steps > min(demo.num_steps for demo in demos)
    assert batch["rgb_top"].shape == (8, steps + 1, 3, 128, 256)
    assert batch["pose1_rotation"].shape == (8, steps, 4)
    assert batch["mask"].sum(1).tolist() == [demo.num_steps for demo in demos]
    assert batch["prompt_mask"].sum(1).tolist() == [len(demo.prompt.images) for demo in demos]
    assert batch["prompt"] == [demo.prompt.text for demo in demos]
    row, demo = next((k, demo) for k, demo in enumerate(demos) if demo.num_steps < steps)
    last = demo.num_steps
    assert torch.equal(batch["segm_front"][row, : last + 1], torch.from_numpy(np.array(demo.segm["front"])))
    assert (batch["segm_front"][row, last + 1 :] == 255).all()
    assert (batch["pick_ids"][row, last:] == -1).all() and not batch["pose0_position"][row, last:].any()
    for number, (name, image) in enumerate(demo.prompt.images.items()):
        assert batch["prompt_names"][row][number] == name
        assert (batch["prompt_rgb_top"][row, number].numpy() == image.rgb["top"]).all()


def test_slices_are_data_sets(demos: Dataset) -> None:
    items = DemonstrationDataset(demos, lambda demo: demo.seed)
    seeds = [demo.seed for demo in demos]
    assert list(items[2:7:2]) == seeds[2:7:2]
    assert list(items[2:][1:3]) == seeds[3:5]
    assert items[:3][-1] == seeds[2]
    assert len(items[:100]) == len(items) == 8
    with pytest.raises(IndexError, match="episode 3 of 3; count from 0 to 2"):
        items[:3][3]
    copied = pickle.loads(pickle.dumps(DemonstrationDataset(demos)[5:]))
    assert torch.equal(copied[0]["rgb_top"], DemonstrationDataset(demos)[5]["rgb_top"])
    with pytest.raises(ShapeError, match="at least one"):
        collate([])


@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # on a machine of two processors
@pytest.mark.parametrize("workers", [1, 3])
def test_loader_workers_do_not_change_the_batches(workers: int) -> None:
    order = BatchOrder(60, batch_size=4, seed=2)
    expected = [order.rows(number).tolist() for number in range(30)]
    loader = BatchLoader(Numbers(60), order, num_workers=workers)
    assert [*loader, *loader] == expected


def test_a_transform_is_told_the_number_of_its_batch() -> None:
    order = BatchOrder(60, batch_size=4, seed=2)
    loader = BatchLoader(Numbers(60), order, num_workers=2, transform=numbered)
    list(loader)
    assert next(iter(loader)) == (15, order.rows(15).tolist())


def test_an_epoch_ends_and_the_next_one_follows() -> None:
    order = BatchOrder(10, batch_size=4, seed=2)
    loader = BatchLoader(Numbers(10), order, transform=total)
    assert len(loader) == 2
    assert len(list(loader)) == 2
    assert loader.epoch == 1
    assert [int(batch) for batch in loader] == [order.rows(n).sum() for n in (2, 3)]
    forever = loader.forever()
    assert [int(next(forever)) for _ in range(5)] == [order.rows(n).sum() for n in range(4, 9)]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_position_is_that_of_what_was_shown_not_of_what_was_read_ahead(workers: int) -> None:
    order = BatchOrder(60, batch_size=4, seed=2)
    loader = BatchLoader(Numbers(60), order, num_workers=workers)
    batches = iter(loader)
    shown = [next(batches) for _ in range(5)]
    state = json.loads(json.dumps(loader.state_dict()))
    rest = list(batches)
    other = BatchLoader(Numbers(60), order, num_workers=2 - workers)
    other.load_state_dict(state)
    assert list(other) == rest
    assert [*shown, *rest] == [order.rows(number).tolist() for number in range(15)]


def test_ranks_that_become_more_go_on_where_one_was() -> None:
    whole = BatchOrder(60, batch_size=4, seed=2)
    one = BatchLoader(Numbers(60), whole)
    forever = one.forever()
    for _ in range(17):
        next(forever)
    seen = []
    for rank in range(2):
        part = BatchLoader(Numbers(60), replace(whole, rank=rank, num_ranks=2))
        part.load_state_dict(one.state_dict())
        seen += next(part.forever())
    assert sorted(seen) == sorted(whole.rows(17))


def test_a_position_of_another_order_is_refused() -> None:
    order = BatchOrder(60, batch_size=4, seed=2)
    state = BatchLoader(Numbers(60), order).state_dict()
    with pytest.raises(ConfigError, match=r"another order: seed was 2, is 3"):
        BatchLoader(Numbers(60), replace(order, seed=3)).load_state_dict(state)
    with pytest.raises(ConfigError, match="the order is for 60 episodes; there are 59"):
        BatchLoader(Numbers(59), order)


def test_the_global_generator_is_left_alone() -> None:
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    list(BatchLoader(Numbers(60), BatchOrder(60, batch_size=4, seed=2)))
    assert torch.equal(torch.rand(1), expected)


@pytest.mark.parametrize("source", ["images", "tokens"])
def test_episodes_of_a_data_set_come_in_batches(demos: Dataset, source: str) -> None:
    episodes = demos if source == "images" else open_object_cache(demos)
    loader = BatchLoader(episodes, BatchOrder(8, batch_size=4, seed=0), num_workers=1)
    seen = [(episode.task, episode.seed) for batch in loader for episode in batch]
    assert sorted(seen) == sorted((demo.task, demo.seed) for demo in demos)


def test_a_demonstration_without_steps_has_tensors_without_rows(demos: Dataset) -> None:
    demo = demos[0]
    start = {
        "rgb": {view: images[:1] for view, images in demo.rgb.items()},
        "segm": {view: images[:1] for view, images in demo.segm.items()},
    }
    item = tensors_of(replace(demo, actions=(), pick_ids=(), place_ids=(), joint_paths=(), **start))
    assert item["pose0_position"].shape == (0, 2)
    assert item["pose1_rotation"].shape == (0, 4)


def tensors(episodes: list[int], number: int) -> dict[str, object]:
    return {"ones": torch.ones(100), "nested": [(torch.arange(number + 1), np.arange(3))], "text": "a"}


def refuse(tensor: torch.Tensor) -> None:
    raise RuntimeError("unable to allocate shared memory(shm) for file </torch_1>: No space left on device")


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
@pytest.mark.parametrize("lack", ["known", "found out"])
def test_without_room_in_shared_memory_workers_send_batches_through_the_pipe(
    demos: Dataset, monkeypatch: pytest.MonkeyPatch, lack: str
) -> None:
    """Docker gives containers 64 MB of it; such a loader stood still for ever."""
    items = DemonstrationDataset(demos)
    expected = next(iter(DataLoader(items, batch_size=8)))
    if lack == "known":
        monkeypatch.setattr(torch_batches, "_room", lambda: 1000)
    else:
        monkeypatch.setattr(torch.Tensor, "share_memory_", refuse)
    options = {"num_workers": 2, "multiprocessing_context": "fork", "timeout": 60}
    (batch,) = DataLoader(items, batch_size=8, **options)
    assert type(batch) is dict and batch.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(batch[name], value) and not batch[name].is_shared()
        else:
            assert batch[name] == value

    order = BatchOrder(8, batch_size=2, seed=0)
    for number, made in enumerate(BatchLoader(Numbers(8), order, transform=tensors, num_workers=2)):
        assert made["ones"].sum() == 100 and made["text"] == "a"
        assert made["nested"][0][0].tolist() == list(range(number + 1))


@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_with_room_batches_are_in_shared_memory(demos: Dataset) -> None:
    loader = DataLoader(
        DemonstrationDataset(demos), batch_size=4, num_workers=1, multiprocessing_context="fork"
    )
    assert all(batch["rgb_top"].is_shared() for batch in loader)
    order = BatchOrder(8, batch_size=2, seed=0)
    loader = BatchLoader(Numbers(8), order, transform=tensors, num_workers=1, context="fork")
    assert all(batch["nested"][0][0].is_shared() for batch in loader)
