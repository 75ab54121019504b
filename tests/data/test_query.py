"""Demonstrations are found by what they hold."""

from pathlib import Path

import pytest

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.reader import DemonstrationQuery, find_demonstrations
from openvima.errors import DatasetError


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    tasks = ("manipulate_old_neighbor", "visual_manipulation")
    return Dataset(generate(GenerateConfig(tmp_path_factory.mktemp("found"), tasks, episodes=5)))


def test_each_field_finds_what_a_walk_over_all_demonstrations_finds(dataset: Dataset) -> None:
    demos = list(dataset)
    shown = demos[3].objects[0]
    cases = {
        DemonstrationQuery(): lambda d: True,
        DemonstrationQuery(task="visual_manipulation"): lambda d: d.task == "visual_manipulation",
        DemonstrationQuery(level="L1"): lambda d: False,
        DemonstrationQuery(min_steps=2): lambda d: d.num_steps >= 2,
        DemonstrationQuery(max_steps=1): lambda d: d.num_steps <= 1,
        DemonstrationQuery(object=shown.object): lambda d: shown.object in {o.object for o in d.objects},
        DemonstrationQuery(texture=shown.texture): lambda d: shown.texture in {o.texture for o in d.objects},
        DemonstrationQuery(object=shown.object, texture=shown.texture): lambda d: (
            (shown.object, shown.texture) in {(o.object, o.texture) for o in d.objects}
        ),
    }
    for query, fits in cases.items():
        expected = [index for index, demo in enumerate(demos) if fits(demo)]
        assert find_demonstrations(dataset, query).tolist() == expected, query
    assert 0 < len(find_demonstrations(dataset, DemonstrationQuery(min_steps=2))) < len(demos)


def test_object_and_texture_mean_one_object(dataset: Dataset) -> None:
    first, second = dataset[0].objects[:2]
    assert (first.object, first.texture) != (second.object, second.texture)
    mixed = DemonstrationQuery(object=first.object, texture=second.texture)
    fits = [
        index
        for index, demo in enumerate(dataset)
        if any((o.object, o.texture) == (first.object, second.texture) for o in demo.objects)
    ]
    assert find_demonstrations(dataset, mixed).tolist() == fits and 0 not in fits


def test_unknown_names_are_refused(dataset: Dataset, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no object 'hart'\. Did you mean 'heart'\?"):
        DemonstrationQuery(object="hart")
    with pytest.raises(DatasetError, match=r"task in .* called 'rotate'"):
        find_demonstrations(dataset, DemonstrationQuery(task="rotate"))
