"""Extractors by name: lookup, cache names and object caches."""

import pickle
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from openvima.data import Dataset
from openvima.data.preprocessed import preprocess
from openvima.detector.checkpoint import save_network
from openvima.detector.network import MaskRCNN
from openvima.detector.plugins import (
    PluggedExtractor,
    detected_object_cache,
    plugged_boxes,
    plugged_extractor,
)
from openvima.env import TabletopEnv
from openvima.errors import ConfigError, InputFileError
from openvima.perception.objects import GROUND_TRUTH, GroundTruth
from small_data_sets import rows_of

EXTRACTORS = Path(__file__).parents[1] / "plugged_extractors.py"


def test_a_detector_of_a_module_is_found_by_name(monkeypatch):
    monkeypatch.syspath_prepend(str(EXTRACTORS.parent))
    extractor = plugged_extractor("plugged_extractors:truth")
    sys.modules.pop("plugged_extractors")
    assert extractor.extractor == GROUND_TRUTH


def test_where_something_is_found_it_is_left_as_it_is():
    extractor = plugged_extractor("openvima.perception.objects:GroundTruth")
    assert extractor.extractor == GroundTruth()
    env = TabletopEnv("rotate", level="L1")
    observation, _ = env.reset(seed=0)
    assert np.array_equal(
        extractor.in_observation(observation).ids, GroundTruth().in_observation(observation).ids
    )


def test_what_makes_no_extractor_is_named():
    with pytest.raises(ConfigError, match="returned a dict"):
        plugged_extractor("builtins:dict")


def test_a_trained_detector_is_found_by_its_folder(tmp_path):
    with pytest.raises(InputFileError, match="no folder"):
        plugged_extractor(f"detector={tmp_path / 'none'}")
    with pytest.raises(InputFileError, match="no checkpoint"):
        plugged_extractor(f"detector={tmp_path}")


def test_only_what_a_view_shows_is_found_and_one_hidden_object_stands_for_nothing():
    extractor = plugged_extractor(f"{EXTRACTORS}:Blind")
    env = TabletopEnv("rotate", level="L1")
    observation, _ = env.reset(seed=0)
    found = extractor.in_observation(observation)
    assert len(found) == 1
    assert not found.masks.any()
    assert len(extractor.in_prompt_image(next(iter(env.prompt.images.values())))) == 0


def test_images_are_announced_only_to_an_extractor_that_takes_several():
    class Ahead(GroundTruth):
        def extract_ahead(self, observations, images):
            announced.append((observations, images))

    announced = []
    for extractor in (GROUND_TRUTH, Ahead()):
        PluggedExtractor(extractor).extract_ahead([{}], [])
    assert announced == [([{}], [])]


def test_the_name_of_a_function_follows_from_its_file(tmp_path):
    names = {plugged_boxes(f"{EXTRACTORS}:{function}").name for function in ("truth", "truth", "Blind")}
    assert sorted(name.partition("-")[0] for name in names) == ["Blind", "truth"]
    elsewhere = shutil.copy(EXTRACTORS, tmp_path / "copy.py")
    assert plugged_boxes(f"{elsewhere}:truth").name in names
    Path(elsewhere).write_text(EXTRACTORS.read_text() + "\n")
    assert plugged_boxes(f"{elsewhere}:truth").name not in names


def test_the_name_of_a_detector_follows_from_its_weights_and_sizes(tmp_path, tiny):
    names = []
    for number, config in enumerate((tiny, tiny, replace(tiny, nms_iou=0.4))):
        torch.manual_seed(min(number, 1))
        save_network(MaskRCNN(config), tmp_path / str(number))
        names.append(plugged_boxes(f"detector={tmp_path / str(number)}").name)
    shutil.copytree(tmp_path / "0", tmp_path / "moved")
    names.append(plugged_boxes(f"detector={tmp_path / 'moved'}").name)
    assert names[3] == names[0]
    assert len(set(names)) == 3
    assert all(name.startswith("detector-") for name in names)


def test_the_object_cache_of_a_detector_equals_its_extractor_on_one_thread(tmp_path, tiny, data):
    save_network(MaskRCNN(replace(tiny, rpn_pre_nms_top_n=4, rpn_post_nms_top_n=3)), tmp_path / "detector")
    boxes = plugged_boxes(f"detector={tmp_path / 'detector'}")
    assert pickle.loads(pickle.dumps(boxes)) == boxes
    dataset, threads = Dataset(data, tasks=["rotate"]), torch.get_num_threads()
    cache = detected_object_cache(dataset, boxes, folder=tmp_path / "tokens")
    assert torch.get_num_threads() == threads
    extractor = plugged_extractor(f"detector={tmp_path / 'detector'}")
    demo, tokens = dataset[0], cache[0]
    expected = preprocess(demo, "objects", extractor)
    assert rows_of(tokens.objects).tolist() == rows_of(expected.objects).tolist()
