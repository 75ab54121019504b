"""Prompt images by name, and prompts with another text."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.perception.preprocessing import ObjectTable, PreprocessedPrompt, image_names

DEFINITION = "This is a {noun} {image}."  # as in `novel_noun`

NamedImages = dict[str, tuple[ObjectTable, bool]]


def images_by_name(prompt: PreprocessedPrompt) -> NamedImages:
    """Return the objects of each prompt image, and whether it is a scene, by its name."""
    tables = prompt.objects.split(prompt.objects_per_image)
    return dict(zip(prompt.image_names, zip(tables, prompt.is_scene.tolist(), strict=True), strict=True))


def with_prompt(
    episode: PreprocessedEpisode, text: str, images: Mapping[str, tuple[ObjectTable, bool]]
) -> PreprocessedEpisode:
    """Return the demonstration with another prompt, which contains some of these images."""
    shown = [images[name] for name in image_names(text)]
    prompt = PreprocessedPrompt(
        text=text,
        objects=ObjectTable.concatenate([table for table, _ in shown]),
        objects_per_image=np.array([len(table) for table, _ in shown], np.int16),
        is_scene=np.array([is_scene for _, is_scene in shown], np.bool_),
    )
    return replace(episode, prompt=prompt)
