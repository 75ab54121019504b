"""Rendering the images of demonstrations again: as they were, or with random shapes and textures.

Demonstrations may be stored without images. Those of the prompt follow from the seed, those of the cameras
from the stored scenes; both depend on the code that samples and draws, so the result is compared with the
content hash of the demonstration as it was seen.

With a random appearance, poses and actions stay. Each shape and texture of a demonstration gets a random one
in its place, the same in all its images, and what the prompt says stays true:

- Names that the prompt has in words stay what they are; so does the neutral gray of images of shapes.
- Shapes whose heading is visible get such shapes, and movable objects keep their heights.
- A dark texture becomes the dark variant of what replaces its light one.
- Where the prompt asks for a profile, movable objects keep their shapes, and containers their profile.

Only movable objects and containers of the training partition get other shapes. Random shapes know nothing of
the catalogue's; gratings were added after containers with gaps had failed at L3.
"""

import dataclasses
import re
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.catalog.objects import OBJECTS, ObjectSpec, object_spec
from openvima.catalog.packs import load_assets, recorded_assets
from openvima.catalog.partitions import OBJECT_SETS
from openvima.catalog.random_pack import RandomAppearanceAssets, has_visible_heading, random_name
from openvima.catalog.textures import NEUTRAL_TEXTURE, texture_spec
from openvima.data.encoding import ShardInfo
from openvima.data.records import Demonstration, package_versions
from openvima.data.schema import VIEWS
from openvima.errors import ConfigError, DatasetError, SamplingError, UnknownTaskError, differences
from openvima.render.rasteriser import Rasteriser
from openvima.scene import ObjectImage, Placement, Pose, Prompt, Scene, SceneImage
from openvima.scene.prompt import PLACEHOLDER, PromptFill
from openvima.tasks.prompts import MULTIMODAL

RERENDERING_VERSION = 1  # grows whenever the same demonstration gets another appearance
_MOVABLE = {*OBJECT_SETS["D_shape"], *OBJECT_SETS["D_train"]}
_CONTAINERS = OBJECT_SETS["B_train"]
_CONTAINER_KINDS = ("container", "container", "grating", "eared container")
_PROFILE_KINDS = {"square": "square container", "circle": "round container"}
# Seeds of the appearances of a variant, few enough to cache: drawing new ones doubles the time.
_POOL_SIZE, _NUM_CACHED = 1024, 4096
UNKNOWN_SCENES = (
    "{} has no scenes, as imported data, so it cannot be rendered with another appearance; leave out "
    "loader.rerendered_prob."
)
_PROFILE = re.compile(r"\b(profiles?|outlines?|shapes?)\b", re.IGNORECASE)


def rerender(demo: Demonstration, info: ShardInfo, content_hash: str) -> Demonstration:
    """Render the images of a demonstration.

    Args:
        demo: The demonstration without images, as `decode` gives it.
        info: What the file says about all its rows.
        content_hash: Of the demonstration with images.

    Returns:
        The demonstration with the images that the environment showed when it was recorded.

    Raises:
        DatasetError: It is not the same any more: the packages that render are others than those that wrote.
        AssetError: The asset pack is not there, or is a function that was not loaded before.
        UnknownNameError: An object or texture of a user is not registered.
    """
    try:
        result = _render(demo, _rasteriser(info.assets), demo.scenes, sample_prompt(demo, info))
    except (SamplingError, ConfigError, UnknownTaskError) as error:  # the task is another one, or gone
        raise _explain_change(demo, info, f" ({error})") from error
    if result.content_hash() != content_hash:
        raise _explain_change(demo, info)
    return result


def _render(
    demo: Demonstration, rasteriser: Rasteriser, scenes: Sequence[Scene], prompt: Prompt
) -> Demonstration:
    """Return the demonstration with the images of these scenes and this prompt."""
    rendered = [rasteriser.scene(scene) for scene in scenes]
    rgb = {view: np.stack([images[view].rgb for images in rendered]) for view in VIEWS}
    segm = {view: np.stack([images[view].segm for images in rendered]) for view in VIEWS}
    return dataclasses.replace(demo, rgb=rgb, segm=segm, prompt=rasteriser.prompt(prompt))


def sample_prompt(demo: Demonstration, info: ShardInfo) -> Prompt:
    """Sample the episode of a demonstration again, and return its prompt.

    Args:
        demo: Names the episode; its own prompt is not used.
        info: Of the shard that stores it.
    """
    settings = dataclasses.replace(info.env_config, assets=recorded_assets(info.assets))
    return settings.sample(demo.task, demo.level, demo.seed, domain=demo.domain).problem.prompt


@lru_cache(maxsize=4)
def _rasteriser(assets: str, *, is_random: bool = False) -> Rasteriser:
    pack = load_assets(recorded_assets(assets))
    return Rasteriser(RandomAppearanceAssets(pack, _NUM_CACHED) if is_random else pack)


def _explain_change(demo: Demonstration, info: ShardInfo, details: str = "") -> DatasetError:
    others = "; ".join(differences(info.versions, package_versions()))
    cause = f"Versions differ: {others}" if others else "The task, the asset pack or the file is another one"
    return DatasetError(
        f"{demo.task} of seed {demo.seed} is stored without images and cannot be rerendered identically"
        f"{details}. {cause}."
    )


def with_random_appearance(demo: Demonstration, info: ShardInfo, variant: int) -> Demonstration:
    """Render a demonstration with random shapes and textures.

    Args:
        demo: The demonstration; its images are not used.
        info: Of the shard that stores it.
        variant: Number that draws the appearance, together with task and seed.

    Raises:
        DatasetError: Its scenes are unknown.
    """
    if not demo.scenes:
        raise DatasetError(UNKNOWN_SCENES.format(f"the demonstration of {demo.task} with seed {demo.seed}"))
    rasteriser = _rasteriser(info.assets, is_random=True)
    prompt = sample_prompt(demo, info)
    placements = [*demo.scenes[0].placements, *_shown(prompt)]
    rng = np.random.default_rng([variant, demo.seed, *demo.task.encode()])
    in_words = info.prompts != MULTIMODAL
    appearance = RandomAppearance(
        placements, prompt.text, in_words=in_words, variant=variant, assets=rasteriser.assets, rng=rng
    )
    images = tuple((name, appearance.of_image(fill)) for name, fill in prompt.images)
    scenes = list(map(appearance.of_scene, demo.scenes))
    return _render(demo, rasteriser, scenes, dataclasses.replace(prompt, images=images))


class RandomAppearance:
    """Which random shape and texture replaces which.

    Args:
        placements: All objects of a demonstration.
        text: Its prompt; textures that it names stay.
        in_words: Whether it describes objects in words; shapes that it names stay, too. Else "container" is
            but a word.
        variant: Number of the pool of appearances.
        assets: The pack.
        rng: Source of all draws.
    """

    def __init__(
        self,
        placements: Iterable[Placement],
        text: str,
        *,
        in_words: bool,
        variant: int,
        assets: Assets,
        rng: np.random.Generator,
    ) -> None:
        self._assets, self._rng = assets, rng
        self._pool = range(variant * _POOL_SIZE, (variant + 1) * _POOL_SIZE)
        self._shapes: dict[str, str] = {}
        self._textures: dict[str, str] = {}
        keeps_profiles = _PROFILE.search(text) is not None
        for placement in placements:
            name, light = placement.object, texture_spec(placement.texture).light_variant
            if name not in self._shapes:
                is_kept = in_words and _occurs(name, text)
                self._shapes[name] = name if is_kept else self._other_shape(object_spec(name), keeps_profiles)
            if light not in self._textures:
                is_kept = light == NEUTRAL_TEXTURE or _occurs(light, text)
                self._textures[light] = light if is_kept else self._draw("texture")

    def of(self, placement: Placement) -> Placement:
        """Return an object with its new appearance, as high above the table."""
        name, spec = self._shapes[placement.object], texture_spec(placement.texture)
        texture = f"{'dark ' if spec.is_dark else ''}{self._textures[spec.light_variant]}"
        new = dataclasses.replace(placement, object=name, texture=texture)
        if name == placement.object:
            return new
        old = self._assets.geometry(placement.object, placement.size, placement.scale)
        if placement.object in _MOVABLE:
            plain = self._assets.geometry(name, placement.size, placement.scale)
            factor = _height_m(old.visual.vertices) / _height_m(plain.visual.vertices)
            x, y, z = placement.scale
            new = dataclasses.replace(new, scale=(x, y, z * factor))
        rest_z_m = self._assets.geometry(name, new.size, new.scale).rest_z_m
        position = (new.pose.x, new.pose.y, new.pose.z - old.rest_z_m + rest_z_m)
        return new.at(Pose(position, new.pose.quaternion))

    def of_scene(self, scene: Scene) -> Scene:
        """Return a scene with the new appearance."""
        return dataclasses.replace(scene, placements=tuple(map(self.of, scene.placements)))

    def of_image(self, image: PromptFill) -> PromptFill:
        """Return a prompt image with the new appearance; a photo stays."""
        if isinstance(image, ObjectImage):
            return dataclasses.replace(image, placement=self.of(image.placement))
        return SceneImage(self.of_scene(image.scene)) if isinstance(image, SceneImage) else image

    def _draw(self, kind: str) -> str:
        """Draw an appearance that nothing has yet."""
        used = {*self._shapes.values(), *self._textures.values()}
        while (name := random_name(kind, self._rng, self._pool)) in used:
            pass
        return name

    def _other_shape(self, spec: ObjectSpec, keeps_profiles: bool) -> str:
        if spec.name in _CONTAINERS:
            if keeps_profiles and spec.profile is not None:
                return self._draw(_PROFILE_KINDS[spec.profile])
            return self._draw(_CONTAINER_KINDS[int(self._rng.integers(len(_CONTAINER_KINDS)))])
        if spec.name not in _MOVABLE or keeps_profiles:
            return spec.name
        while True:
            name = self._draw("shape")
            if has_visible_heading(name) or not has_visible_heading(spec.name):
                return name


def _occurs(name: str, text: str) -> bool:
    """Whether a text has a name, or another name of that object, outside of its placeholders."""
    spec = OBJECTS.get(name)
    names = "|".join(map(re.escape, (name, *(spec.aliases if spec else ()))))
    return re.search(rf"\b({names})(s|es)?\b", PLACEHOLDER.sub("", text), re.IGNORECASE) is not None


def _shown(prompt: Prompt) -> Iterator[Placement]:
    """Yield the objects of all prompt images."""
    for _, image in prompt.images:
        if isinstance(image, ObjectImage):
            yield image.placement
        elif isinstance(image, SceneImage):
            yield from image.scene.placements


def _height_m(vertices: np.ndarray) -> float:
    return float(np.ptp(vertices[..., 2]))
