"""Rendering the images of demonstrations that were stored without them.

The prompt's images follow from the seed, those of the cameras from the stored scenes. Both depend on the code
that samples and draws, so the result is compared with the content hash of the demonstration as it was seen.
"""

import dataclasses
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.catalog.packs import load_assets
from openvima.catalog.user_assets import recorded_assets
from openvima.data.encoding import ShardInfo
from openvima.data.records import Demonstration, package_versions
from openvima.data.schema import VIEWS
from openvima.errors import (
    AssetError,
    OpenVimaError,
    ShardError,
    UnknownObjectError,
    UnknownTextureError,
)
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Prompt, RenderedPrompt, Scene
from openvima.tasks import sample_episode


def rerendered(demo: Demonstration, info: ShardInfo, content_hash: str) -> Demonstration:
    """Render the images of a demonstration.

    Args:
        demo: The demonstration without images, as `decode` gives it.
        info: What the file says about all its rows.
        content_hash: Of the demonstration with images.

    Returns:
        The demonstration with the images that the environment showed when it was recorded.

    Raises:
        ShardError: It is not the same any more: the packages that draw are others than those that wrote.
        AssetError: The asset pack is not there, or is a function that was not loaded before.
        UnknownObjectError, UnknownTextureError: An object or texture of a user is not registered.
    """
    try:
        rgb, segm = draw_observations(demo.scenes, info)
        prompt = draw_prompt(demo, info)
    except (AssetError, UnknownObjectError, UnknownTextureError):
        raise
    except OpenVimaError as error:  # the task draws no episode for this seed, or is gone
        raise _changed(demo, info, f" ({error})") from error
    result = dataclasses.replace(demo, rgb=rgb, segm=segm, prompt=prompt)
    if result.content_hash() != content_hash:
        raise _changed(demo, info)
    return result


def draw_observations(
    scenes: Sequence[Scene], info: ShardInfo
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Render the observations of some scenes.

    Args:
        scenes: N scenes.
        info: Of the shard that stores them.

    Returns:
        View name to images, shape (N, 3, 128, 256), uint8; view name to object ids, shape (N, 128, 256),
        uint8.
    """
    return draw_with(_rasteriser(info.assets), scenes)


def draw_with(
    rasteriser: Rasteriser, scenes: Sequence[Scene]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Render the observations of some scenes; see `draw_observations`."""
    drawn = [rasteriser.scene(scene) for scene in scenes]
    rgb = {view: np.stack([images[view].rgb for images in drawn]) for view in VIEWS}
    segm = {view: np.stack([images[view].segm for images in drawn]) for view in VIEWS}
    return rgb, segm


def draw_prompt(demo: Demonstration, info: ShardInfo) -> RenderedPrompt:
    """Render the prompt images of a demonstration.

    Args:
        demo: Names the episode; its own prompt is not used.
        info: Of the shard that stores it.
    """
    rasteriser = _rasteriser(info.assets)
    return rasteriser.prompt(sampled_prompt(demo, info, rasteriser.assets))


def sampled_prompt(demo: Demonstration, info: ShardInfo, assets: Assets) -> Prompt:
    """Sample the episode of a demonstration again, and return its prompt.

    Args:
        demo: Names the episode; its own prompt is not used.
        info: Of the shard that stores it.
        assets: The pack of the shard.
    """
    episode = sample_episode(
        demo.task,
        level=demo.level,
        seed=demo.seed,
        domain=demo.domain,
        assets=assets,
        compat=info.compat,
        prompts=info.prompts,
        **info.env_config.options(demo.task),
    )
    return episode.problem.prompt


@lru_cache(maxsize=2)
def _rasteriser(assets: str) -> Rasteriser:
    return Rasteriser(load_assets(recorded_assets(assets)))


def _changed(demo: Demonstration, info: ShardInfo, details: str = "") -> ShardError:
    installed = package_versions()
    others = [
        f"{name} {info.versions.get(name, 'none')} (installed: {installed.get(name, 'none')})"
        for name in sorted(installed.keys() | info.versions.keys())
        if info.versions.get(name) != installed.get(name)
    ]
    versions = (
        "all versions as installed; so the task or the asset pack is another one, or the file is damaged"
    )
    if others:
        versions = f"{', '.join(others)}; read it with those, or generate it again"
    return ShardError(
        f"{demo.task} of seed {demo.seed} is stored without images and cannot be rerendered identically"
        f"{details}. It was written with {versions}."
    )
