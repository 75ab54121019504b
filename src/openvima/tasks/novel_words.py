"""Invented words: nouns, and adjectives defined by comparing objects that differ in one attribute alone."""

from dataclasses import dataclass, replace
from typing import Literal

from openvima.catalog import Vector3
from openvima.catalog.textures import NEUTRAL_TEXTURE, texture_spec
from openvima.scene import ObjectImage, Placement, Pose, Problem, Prompt
from openvima.tasks.placing import APART_M, into_base, of_a_third_shape, place_base, place_distractors
from openvima.tasks.table import NO_SCALE, TableSampler

ADJECTIVES = ("daxer", "blicker", "modier", "kobar")
NOUNS = ("dax", "blicket", "wug", "zup")


def gray_image(placement: Placement) -> ObjectImage:
    """Return an image of the shape alone, without texture and scale."""
    return ObjectImage(replace(placement, texture=NEUTRAL_TEXTURE, scale=NO_SCALE))


MEANINGS = ("shorter", "taller", "lighter", "darker")
NUM_COMPARISONS = 3
_NO_ID = 0  # of objects in the prompt only
_ORIGIN = Pose((0.0, 0.0, 0.0))  # object images have a pose of their own


@dataclass(frozen=True, slots=True)
class Attribute:
    """One side of a comparison: scale and shade of an object.

    Args:
        scale: Factor per axis.
        shade: Variant of its texture; None: unchanged.
    """

    scale: Vector3 = NO_SCALE
    shade: Literal["light", "dark"] | None = None

    def texture(self, name: str) -> str:
        """Return the variant of a texture."""
        if self.shade is None:
            return name
        light = texture_spec(name).light_variant
        dark = texture_spec(light).dark_variant
        return light if self.shade == "light" or dark is None else dark


@dataclass(frozen=True, slots=True)
class AdjectiveExample:
    """Comparisons that define an adjective, and the attribute that the prompt asks for.

    Args:
        fills: Values of the slots of `COMPARISONS`, and of the slots `adv` and `novel_adj` of the request.
        asked: Attribute of the target.
        other: Attribute of its twin.
    """

    fills: dict[str, ObjectImage | str]
    asked: Attribute
    other: Attribute


COMPARISONS = " ".join(
    f"{{demo_blicker_obj_{n}}} is {{novel_adj}} than {{demo_less_blicker_obj_{n}}}."
    for n in range(1, NUM_COMPARISONS + 1)
)


def sample_adjective_example(table: TableSampler) -> AdjectiveExample:
    """Draw an adjective, its meaning, and pairs of objects that illustrate it."""
    adjective = table.shuffled(ADJECTIVES)[0]
    meaning = table.choose(MEANINGS)
    more, less = _attributes(table, meaning)
    is_flipped = table.choose((False, True))
    fills: dict[str, ObjectImage | str] = {"adv": "less " if is_flipped else "", "novel_adj": adjective}
    for n in range(1, NUM_COMPARISONS + 1):
        object_name = table.choose(table.pool.dragged_objects)
        texture = table.choose(table.pool.dragged_textures)
        size = table.sample_size(object_name)
        for slot, attribute in ((f"demo_blicker_obj_{n}", more), (f"demo_less_blicker_obj_{n}", less)):
            shown = Placement(
                _NO_ID, object_name, attribute.texture(texture), size, _ORIGIN, scale=attribute.scale
            )
            fills[slot] = ObjectImage(shown)
    asked, other = (less, more) if is_flipped else (more, less)
    return AdjectiveExample(fills, asked, other)


def adjective_problem(
    table: TableSampler,
    example: AdjectiveExample,
    template: str,
    *,
    num_distractors: int,
    difficulty: str,
    **words: str,
) -> Problem:
    """Place a base, the target and its twin, and distractors of other shapes; build the problem.

    Args:
        table: Sampler of the scene.
        example: The attributes of target and twin.
        template: The prompt, with slots `dragged_obj` and `base_obj` for gray images of target and base.
        num_distractors: Distractors of any shape, bases included, besides those of the difficulty.
        difficulty: "easy"; "medium" and "hard" add an object of another shape with the attribute of the twin
            or of the target.
        **words: Further slots of the prompt.
    """
    pool = table.pool
    base_texture, texture = table.choose(pool.base_textures), table.choose(pool.dragged_textures)
    base = place_base(table, base_texture)
    shape, other_shape = table.shuffled(pool.dragged_objects)[:2]
    size = table.sample_size(shape)

    def put(what: str, object_name: str, attribute: Attribute, size: Vector3 | None) -> Placement:
        appearance = (object_name, attribute.texture(texture))
        return table.place_one(what, lambda: appearance, size=size, scale=attribute.scale, apart_m=APART_M)

    target = put("target", shape, example.asked, size)
    others = [put("twin", shape, example.other, size)]
    if difficulty != "easy":
        attribute = example.asked if difficulty == "hard" else example.other
        others.append(put("object of another shape", other_shape, attribute, size if table.compat else None))
    draw = of_a_third_shape(table, base, target, (*pool.dragged_textures, *pool.base_textures))
    others += place_distractors(table, draw, count=num_distractors)
    images = {"dragged_obj": gray_image(target), "base_obj": gray_image(base)}
    prompt = Prompt.parse(template, **example.fills, **words, **images)
    return into_base(table, prompt, target=target, base=base, distractors=others)


def _attributes(table: TableSampler, meaning: str) -> tuple[Attribute, Attribute]:
    """Draw the attributes of an object that has more and of one that has less of the adjective."""
    if meaning in ("shorter", "taller"):
        height = table.rng.uniform(0.3, 0.4)
        low, high = Attribute((1.0, 1.0, height)), Attribute((1.0, 1.0, height + 2.0))
    else:
        low, high = Attribute(shade="light"), Attribute(shade="dark")
    return (low, high) if meaning in ("shorter", "lighter") else (high, low)
