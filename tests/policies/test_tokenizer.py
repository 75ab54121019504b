"""The closed vocabulary: every prompt of the benchmark has ids, everything else is refused."""

from itertools import product

import pytest

from openvima.catalog import OBJECTS, TEXTURES
from openvima.catalog.packs import load_assets
from openvima.errors import PromptError
from openvima.policies.tokenizer import (
    CLOSED_TOKENIZER,
    END_ID,
    LARGEST_NUMBER,
    PADDING_ID,
    encode_text,
    vocabulary_size,
    word_ids,
)
from openvima.render.rasteriser import Rasteriser
from openvima.scene import PromptImage, RenderedPrompt
from openvima.tasks import list_tasks, sample_episode, task_spec

NOUNS = ("dax", "blicket", "wug", "zup")
ADJECTIVES = ("daxer", "blicker", "modier", "kobar")
COMPARISON = " ".join(
    f"{{demo_blicker_obj_{n}}} is ADJECTIVE than {{demo_less_blicker_obj_{n}}}." for n in (1, 2, 3)
)
# Every prompt text of the 17 tasks; words in capitals are filled in below.
TEMPLATES = (
    "Put the {dragged_obj_1} into the {base_obj}.",
    "Put the red swirl object in {scene} into the dark blue object.",
    "Rotate the {dragged_obj} ANGLE degrees.",
    "Rearrange to this {scene}.",
    "Rearrange objects to this setup {scene} and then restore.",
    f"{COMPARISON} Put the ADVERBADJECTIVE {{dragged_obj}} into the {{base_obj}}.",
    "This is a NOUN {dragged_obj_1}. This is a NOUN {base_obj}. Put a NOUN into a NOUN.",
    f"This is a NOUN {{base_obj}}. {COMPARISON} Put the ADVERBADJECTIVE NOUN into the NOUN.",
    '"Twist" is defined as rotating object a specific angle. For examples: From {before_twist_1} to '
    "{after_twist_1}. From {before_twist_2} to {after_twist_2}. From {before_twist_3} to {after_twist_3}. "
    "Now twist all tiger objects.",
    "Follow this motion for {dragged_obj}: {frame_0} {frame_1} {frame_2}.",
    "Stack objects in this order {frame_0} {frame_1} {frame_2}.",
    "Sweep DETERMINER {swept_obj} into {bounds} without exceeding {constraint}.",
    "Sweep DETERMINER {swept_obj} into {bounds} without touching {constraint}.",
    "Put all objects with the same texture as {base_obj} into it.",
    "Put all objects with the same profile as {base_obj} into it.",
    "First put {dragged_obj} into {base_obj} then put the object that was previously at its DIRECTION "
    "into the same {base_obj}.",
    "Put {dragged_obj} into {base_obj_1} then {base_obj_2}. Finally restore it into its original container.",
)
FILLS = {
    "ADVERB": ("", "less "),
    "ADJECTIVE": ADJECTIVES,
    "NOUN": NOUNS,
    "ANGLE": ("30", "60", "90", "120", "150"),
    "DETERMINER": ("any", "one", "two", "three", "all"),
    "DIRECTION": ("north", "south", "west", "east"),
}


# Prompts of the harder variants of some tasks.
HARDER = (
    "Put the {a} and {b} and {c} into the {d}.",
    "Rotate the {a} and {b} -90 degrees.",
    "Sweep one {a} into {b}. Sweep two {a} into {b}. Sweep all {a} into {b}.",
)


def filled(template: str) -> list[str]:
    """Every text that a template can become."""
    slots = [slot for slot in FILLS if slot in template]
    texts = []
    for words in product(*(FILLS[slot] for slot in slots)):
        text = template
        for slot, word in zip(slots, words, strict=True):
            text = text.replace(slot, word)
        texts.append(text)
    return texts


def blank_images(text: str) -> RenderedPrompt:
    names = [part.partition("}")[0] for part in text.split("{")[1:]]
    return RenderedPrompt(text, {name: PromptImage(name, "object", {}, {}, ()) for name in names})


def encoded(prompt: RenderedPrompt) -> list[int | PromptImage]:
    """Ids and images in reading order, as the processor interleaves them."""
    sequence: list[int | PromptImage] = []
    for part in prompt.sequence():
        sequence += CLOSED_TOKENIZER.encode(part) if isinstance(part, str) else [part]
    return [*sequence, CLOSED_TOKENIZER.end_id]


@pytest.mark.parametrize("template", TEMPLATES + HARDER, ids=lambda template: template[:24])
def test_every_prompt_of_the_17_tasks_is_encoded(template: str) -> None:
    for text in filled(template):
        sequence = encoded(blank_images(text))
        assert sequence[-1] == END_ID
        assert sum(isinstance(part, PromptImage) for part in sequence) == text.count("{")
        ids = [part for part in sequence if isinstance(part, int)]
        assert all(PADDING_ID < part < vocabulary_size() for part in ids)


def test_there_are_as_many_templates_as_tasks() -> None:
    assert len(TEMPLATES) == 17


@pytest.mark.parametrize("texture", TEXTURES)
def test_every_texture_can_be_named(texture: str) -> None:
    assert len(encode_text(f"the {texture} object")) == len(texture.split()) + 2


@pytest.mark.parametrize("name", OBJECTS)
def test_every_object_can_be_named_even_by_its_other_names(name: str) -> None:
    spec = OBJECTS[name]
    for word in (name, *spec.aliases, *spec.novel_names):
        assert len(encode_text(word)) == len(word.split())


@pytest.mark.parametrize("task", list_tasks())
def test_sampled_prompts_of_every_task_are_encoded(task: str) -> None:
    rasteriser = Rasteriser(load_assets("procedural"))
    for level in task_spec(task).levels:
        for seed in range(3):
            prompt = sample_episode(task, level=level, seed=seed).problem.prompt
            assert encoded(rasteriser.prompt(prompt))[-1] == END_ID


def test_images_stand_where_their_placeholders_stood() -> None:
    prompt = blank_images("Put the {a} into the {b}.")
    sequence = encoded(prompt)
    ids = word_ids()
    put, into, the, stop = (ids[word] for word in ("put", "into", "the", "."))
    assert sequence == [put, the, prompt.images["a"], into, the, prompt.images["b"], stop, END_ID]


def test_a_placeholder_that_stands_twice_gives_its_image_twice() -> None:
    prompt = blank_images("From {a} to {a}.")
    assert encoded(prompt).count(prompt.images["a"]) == 2


def test_no_two_words_share_an_id() -> None:
    ids = [*word_ids().values(), *(encode_text(str(number))[0] for number in range(LARGEST_NUMBER + 1))]
    assert len(set(ids)) == len(ids) == vocabulary_size() - 2
    assert {PADDING_ID, END_ID}.isdisjoint(ids)


def test_case_and_spaces_do_not_matter() -> None:
    assert encode_text("  PUT   the\nblock. ") == encode_text("put the block .")


def test_words_with_hyphens_are_one_word() -> None:
    assert len(encode_text("three-sided l-shaped counter-clockwise")) == 3


def test_unknown_words_are_all_named_and_the_first_gets_a_suggestion() -> None:
    with pytest.raises(PromptError) as caught:
        encode_text("Rotatte the quokka 30 degrees")
    message = str(caught.value)
    assert "'rotatte'" in message
    assert "'quokka'" in message
    assert "Did you mean 'rotate'?" in message


@pytest.mark.parametrize(
    "text",
    ["361", "9" * 5000, "naïve", "²", "\N{ARABIC-INDIC DIGIT THREE}"],
    ids=lambda text: ascii(text[:8]),
)
def test_numbers_and_letters_beyond_the_vocabulary_are_refused(text: str) -> None:
    with pytest.raises(PromptError):
        encode_text(text)


def test_a_placeholder_without_image_is_refused() -> None:
    with pytest.raises(PromptError):
        encoded(RenderedPrompt("Put the {a} away.", {}))


def test_empty_text_has_no_ids() -> None:
    assert encode_text("") == []
    assert encoded(RenderedPrompt("", {})) == [END_ID]


def test_unknown_words_are_shown_short_and_without_control_characters() -> None:
    with pytest.raises(PromptError) as error:
        encode_text("put \x1b[2J\u202e " + "juggle " * 5000 + "x" * 5000)
    assert str(error.value).isprintable() and len(str(error.value)) < 400
