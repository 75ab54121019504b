"""Data sets with text prompts are read, verified, replayed, extended and batched like others."""

from pathlib import Path

import pytest

from openvima.data import Dataset, GenerateConfig, VerifyConfig, generate, verify
from openvima.data.subsets import MergeConfig, merge
from openvima.env import EnvConfig
from openvima.errors import ConfigError, DatasetError

TEXT = EnvConfig(prompts="text")
SHARD = "rotate-train-00000.arrow"


def config(out: Path, env_config: EnvConfig = TEXT, images: bool = True) -> GenerateConfig:
    return GenerateConfig(
        out=out, tasks=("rotate",), episodes=2, shard_size=2, env_config=env_config, images=images
    )


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A data set with text prompts, and the same with published ones."""
    root = tmp_path_factory.mktemp("data")
    return generate(config(root / "text")), generate(config(root / "multimodal", EnvConfig()))


def test_text_takes_the_place_of_images_and_nothing_else_changes(folders: tuple[Path, Path]) -> None:
    text, multimodal = map(Dataset, folders)
    for demo, published in zip(text, multimodal, strict=True):
        assert not demo.prompt.images and published.prompt.images
        assert demo.prompt.text.startswith("Rotate the ") and "{" not in demo.prompt.text
        assert (demo.seed, demo.scenes) == (published.seed, published.scenes)


def test_the_form_is_recorded_only_where_it_is_not_the_published_one(folders: tuple[Path, Path]) -> None:
    text, multimodal = (Dataset(folder) for folder in folders)
    assert text.manifest["config"]["prompts"] == text.shard(SHARD).info.prompts == "text"
    assert "prompts" not in multimodal.manifest["config"]
    assert b'"prompts"' not in b"".join(multimodal.shard(SHARD).info.to_metadata().values())
    assert multimodal.shard(SHARD).info.prompts == "multimodal"


def test_episodes_are_replayed_and_images_rendered_again(folders: tuple[Path, Path], tmp_path: Path) -> None:
    lean = generate(config(tmp_path / "lean", images=False))
    for folder in (folders[0], lean):
        found = verify(folder, VerifyConfig(replay=None))
        assert not found.problems and found.num_replayed == 2
    assert [demo.prompt.text for demo in Dataset(lean)] == [demo.prompt.text for demo in Dataset(folders[0])]


def test_a_data_set_is_not_extended_with_other_prompts(folders: tuple[Path, Path]) -> None:
    with pytest.raises(DatasetError, match="prompts is text, asked for is multimodal"):
        generate(config(folders[0], EnvConfig()))


def test_episodes_that_two_forms_leave_equal_are_merged_once(tmp_path: Path) -> None:
    every, half = (
        generate(
            GenerateConfig(
                out=tmp_path / p, tasks=("rearrange",), episodes=2, env_config=EnvConfig(prompts=p)
            )
        )
        for p in ("multimodal", "mixed")
    )
    with pytest.raises(DatasetError, match="2 of 4 episodes repeat others"):
        merge(MergeConfig((every, half), tmp_path / "refused"))
    merged = merge(MergeConfig((every, half), tmp_path / "merged", duplicates="skip"))
    assert len(Dataset(merged)) == 2


def test_all_means_the_tasks_with_a_text_form(tmp_path: Path) -> None:
    every = GenerateConfig(out=tmp_path, env_config=TEXT).resolved_tasks()
    assert "rotate" in every and "rearrange" not in every
    with pytest.raises(ConfigError, match="'rearrange' has no text form"):
        GenerateConfig(out=tmp_path, tasks=("rearrange",), env_config=TEXT).resolved_tasks()
    mixed = EnvConfig(prompts="mixed")
    assert "rearrange" in GenerateConfig(out=tmp_path, env_config=mixed).resolved_tasks()
