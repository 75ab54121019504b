"""Ablations of object ids and boxes, in observations and prompt images."""

from dataclasses import replace

import numpy as np

from openvima.env.tabletop import TabletopEnv
from openvima.evaluation.ablations.inputs import AblatedInput, renumbered
from openvima.perception.boxes import BoxJitter
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt


def shuffled(env: TabletopEnv, seen: AblatedInput, rng: np.random.Generator) -> AblatedInput:
    """Permute the ids of the objects on the table, and of those in the scenes of the prompt.

    The order in which a prompt lists the objects of an image stays: a policy that ignores ids and their order
    acts exactly as before.
    """
    prompt = seen.prompt
    id_map = _permutation({placement.id for placement in env.episode.problem.scene.placements}, rng)
    scenes = [image for image in prompt.images.values() if image.kind == "scene"]
    # One permutation for all images, as in the environment: an object keeps its id from frame to frame.
    prompt_id_map = _permutation({record.object_id for image in scenes for record in image.objects}, rng)
    images = {
        name: _relabelled(image, prompt_id_map) if image.kind == "scene" else image
        for name, image in prompt.images.items()
    }
    return replace(seen, prompt=RenderedPrompt(prompt.text, images), id_map=id_map)


def with_shuffled_prompt_objects(prompt: RenderedPrompt, rng: np.random.Generator) -> RenderedPrompt:
    """Let each prompt image list its objects in an order of its own; an object keeps its id."""
    images = {
        name: replace(image, objects=tuple(image.objects[k] for k in rng.permutation(len(image.objects))))
        for name, image in prompt.images.items()
    }
    return replace(prompt, images=images)


def jittered(seen: AblatedInput, pixels: int, rng: np.random.Generator) -> AblatedInput:
    """Move the borders of all boxes, in prompt images and observations."""
    jitter = BoxJitter(pixels, rng)
    images = {name: jitter.prompt_image(image) for name, image in seen.prompt.images.items()}
    return replace(seen, prompt=RenderedPrompt(seen.prompt.text, images), jitter=jitter)


def _permutation(ids: set[int], rng: np.random.Generator) -> np.ndarray:
    table = np.arange(256, dtype=np.uint8)
    table[sorted(ids)] = rng.permutation(sorted(ids))
    return table


def _relabelled(image: PromptImage, id_map: np.ndarray) -> PromptImage:
    records = tuple(
        ObjectRecord(int(id_map[record.object_id]), record.object, record.texture) for record in image.objects
    )
    return replace(image, segm=renumbered(image.segm, id_map), objects=records)
