"""Export of demonstrations as conversations for fine-tuning."""

import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.chat import ChatFormat, demo_turns
from openvima.data.chat_export import export_chat
from openvima.errors import ConfigError, DatasetError

EXPERIMENT = Path(__file__).parents[2] / "experiments" / "vlm" / "closed_loop.py"
FORM = ChatFormat("1000-yx", enlarge=2)


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demos") / "demos"
    generate(GenerateConfig(tasks=("pick_in_order_then_restore", "rotate"), episodes=2, out=out))
    return out


@pytest.fixture(scope="module")
def chats(demos: Path) -> Path:
    return export_chat(demos, demos.parent / "chats", form=FORM, questions=3)


def examples(folder: Path) -> Iterator[dict[str, Any]]:
    return map(json.loads, (folder / "train.jsonl").read_text(encoding="utf-8").splitlines())


def test_what_is_trained_is_what_is_asked(demos: Path, chats: Path) -> None:
    steps = [each for each in examples(chats) if "question" not in each["id"]]
    written = iter(steps)
    for demo in Dataset(demos):
        turns = demo_turns(demo, FORM)
        for end in range(2, len(turns) + 1, 2):
            example = next(written)
            asked = [json.loads(turn.message) for turn in turns[:end]]
            images = iter(example["images"])
            for message, sent in zip(example["messages"], asked, strict=True):
                for block, part in zip(message["content"], sent["content"], strict=True):
                    if block["type"] == "text":
                        assert block == part
                    else:
                        file = chats / next(images)
                        assert part["type"] == "image_url" and file.is_file()
            assert next(images, None) is None
            assert FORM.read_answer(example["messages"][-1]["content"][0]["text"], demo.end_effector)
    assert next(written, None) is None
    view = np.asarray(Image.open(chats / steps[0]["images"][-1]))
    assert view.shape == (256, 512, 3)
    assert np.array_equal(view[::2, ::2], np.moveaxis(Dataset(demos)[0].rgb["top"][0], 0, -1))


def test_questions_are_on_the_scene(demos: Path, chats: Path) -> None:
    asked = [each for each in examples(chats) if "question" in each["id"]]
    texts = [each["messages"][0]["content"][-1]["text"] for each in asked]
    assert len(asked) > 6 and len({text.split()[0] for text in texts}) >= 2
    for each, text in zip(asked, texts, strict=True):
        answer = each["messages"][1]["content"][0]["text"]
        if text.startswith("Where in the picture"):
            assert answer in ("left", "right", "above", "below")
        elif text.startswith("Where is"):
            y, x = json.loads(answer)["point"]
            assert -50 <= y <= 1050 and -50 <= x <= 1050
        else:
            assert json.loads(answer).keys() <= {"objects", "moved"}


def test_llava_has_a_mark_for_each_image(demos: Path) -> None:
    folder = export_chat(demos, demos.parent / "llava", format="llava", tasks=("rotate",))
    for example in examples(folder):
        said = example["conversations"]
        assert [turn["from"] for turn in said] == ["human", "gpt"] * (len(said) // 2)
        assert sum(turn["value"].count("<image>") for turn in said) == len(example["image"])


def test_exports_are_repeatable_and_not_overwritten(demos: Path, chats: Path) -> None:
    again = export_chat(str(demos), str(demos.parent / "again"), form=FORM, questions=3)
    assert (again / "train.jsonl").read_bytes() == (chats / "train.jsonl").read_bytes()
    with pytest.raises(DatasetError, match="is there already"):
        export_chat(demos, again)
    with pytest.raises(ConfigError, match="questions is -1"):
        export_chat(demos, demos.parent / "other", questions=-1)


def closed_loop() -> ModuleType:
    spec = importlib.util.spec_from_file_location("closed_loop", EXPERIMENT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_datasets_and_trl_read_it(chats: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    datasets = pytest.importorskip("datasets")
    trainer = pytest.importorskip("trl.trainer.sft_trainer")
    monkeypatch.chdir(chats)  # paths of images are relative to the export
    loaded = datasets.load_dataset(
        "json", data_files="train.jsonl", split="train", cache_dir=str(chats / "cache")
    )
    loaded = loaded.cast_column("images", datasets.Sequence(datasets.Image()))
    texts = [part["text"] for m in loaded[0]["messages"] for part in m["content"] if part["type"] == "text"]
    processor = closed_loop().build_processor(texts)
    collate = trainer.DataCollatorForVisionLanguageModeling(processor)
    batch = collate([loaded[0], loaded[1]])
    assert batch["pixel_values"].shape[0] == len(loaded[0]["images"]) + len(loaded[1]["images"])
    assert batch["input_ids"].shape[0] == 2
