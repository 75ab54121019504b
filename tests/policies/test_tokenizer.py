"""Vocabularies: of the benchmark, of training data and from files; words that they lack."""

import json

import pytest

from openvima.catalog import OBJECTS, TEXTURES, tasks_at
from openvima.errors import InputFileError, UnknownWordWarning
from openvima.policies.tokenizer import (
    END_ID,
    LARGEST_NUMBER,
    MAX_WORD_LENGTH,
    PADDING_ID,
    RESERVE,
    UNKNOWN,
    VOCABULARY_FILE,
    Vocabulary,
    WordTokenizer,
    benchmark_vocabulary,
    split_words,
)
from openvima.scene.prompt import PLACEHOLDER
from openvima.tasks import list_tasks, sample_episode, task_spec


def encode_text(text: str) -> list[int]:
    return WordTokenizer().encode(text)


# Words that fill the slots of templates.
FILLS = (
    "dax blicket wug zup less daxer blicker modier kobar and any one two three all north south west east "
    "30 60 90 120 150 -90"
)


def test_the_benchmark_has_no_unknown_word() -> None:
    """A warning of one is an error in tests."""
    encode_text(FILLS)
    for texture in TEXTURES:
        assert len(encode_text(f"the {texture} object")) == len(texture.split()) + 2
    for name, spec in OBJECTS.items():
        for word in (name, *spec.aliases):
            assert len(encode_text(word)) == len(word.split())
    for task in {*list_tasks()} - {"reverse_order", *tasks_at("L7")}:  # which have new words
        texts = [task_spec(task).template]
        for level in task_spec(task).levels:
            texts += [sample_episode(task, level=level, seed=seed).problem.prompt.text for seed in range(3)]
        for text in texts:
            ids = encode_text(PLACEHOLDER.sub(" ", text))
            assert all(max(PADDING_ID, END_ID) < one < benchmark_vocabulary().num_ids for one in ids)


def test_no_two_words_share_an_id() -> None:
    ids = [
        *benchmark_vocabulary().ids().values(),
        *(encode_text(str(number))[0] for number in range(LARGEST_NUMBER + 1)),
    ]
    assert len(set(ids)) == len(ids) == benchmark_vocabulary().num_ids - 2
    assert {PADDING_ID, END_ID}.isdisjoint(ids)


def test_case_and_spaces_do_not_matter_and_words_with_hyphens_are_one_word() -> None:
    assert encode_text("  PUT   the\nblock. ") == encode_text("put the block .")
    assert len(encode_text("three-sided l-shaped counter-clockwise")) == 3


def test_unknown_words_are_all_named_once_and_the_first_gets_a_suggestion() -> None:
    tokenizer = WordTokenizer()
    with pytest.warns(UnknownWordWarning) as caught:
        ids = tokenizer.encode("Rotatte the quokka 30 degrees, rotatte it")
    message = str(caught[0].message)
    assert "'rotatte', 'quokka'" in message
    assert "Did you mean 'rotate'?" in message
    unknown = benchmark_vocabulary().ids()[UNKNOWN]
    assert [token == unknown for token in ids] == [True, False, True, False, False, False, True, False]
    assert tokenizer.encode("the quokka")[1] == unknown  # without a second warning, which would be an error
    with pytest.warns(UnknownWordWarning, match="'wombat'"):
        tokenizer.encode("the quokka and the wombat")
    with pytest.warns(UnknownWordWarning, match="'quokka'"):
        WordTokenizer().encode("the quokka")  # another policy


@pytest.mark.parametrize(
    ("text", "count"),
    [("361", 1), ("9" * 5000, 1), ("naïve", 1), ("²", 1), ("\N{ARABIC-INDIC DIGIT THREE}", 1), ("a_zz", 2)],
    ids=lambda value: ascii(value)[:8],
)
def test_numbers_and_letters_beyond_the_vocabulary_are_unknown(text: str, count: int) -> None:
    with pytest.warns(UnknownWordWarning):
        assert encode_text(text).count(benchmark_vocabulary().ids()[UNKNOWN]) == count


def test_the_words_of_texts_follow_the_unknown_token_in_an_order_of_their_own() -> None:
    texts = ["Put it between the", "and the Büro-Stuhl 400 times 30", "."]
    vocabulary = Vocabulary().extended(texts)
    words = (UNKNOWN, ".", "400", "and", "between", "büro-stuhl", "it", "put", "the", "times")
    assert vocabulary.words == words
    assert Vocabulary().extended(reversed(texts)) == vocabulary
    assert len(set(WordTokenizer(vocabulary).encode(" ".join(texts)))) == len(words)
    assert split_words("BU\N{COMBINING DIAERESIS}RO") == ["büro"]


def test_new_words_get_ids_behind_the_known_ones() -> None:
    before = Vocabulary().extended(["put the blue bowl"])
    after = before.extended(["sweep the green bowl", "\x1b " + "x" * (MAX_WORD_LENGTH + 1)])
    assert after.words == (*before.words, "green", "sweep")
    assert after.texture_words == ("blue", "green")
    assert after.extended(["put the green bowl"]) == after
    assert after.size_for(after.num_ids) == after.num_ids
    assert after.size_for(after.num_ids - 1) >= after.num_ids + RESERVE


def test_a_vocabulary_is_read_as_it_was_written(tmp_path) -> None:
    vocabulary = benchmark_vocabulary().extended(["żółw “ 🤖"])
    WordTokenizer(vocabulary).save(tmp_path / "tokenizer")
    assert Vocabulary.read(tmp_path / "tokenizer") == vocabulary
    assert vocabulary.digest() != benchmark_vocabulary().digest()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ('{"words": ["a", "a"], "texture_words": []}', "'a', twice"),
        ('{"words": ["A"], "texture_words": []}', "'A', which is no word"),
        ('{"words": ["\\u001b"], "texture_words": []}', "no word"),
        ('{"words": ["%s"], "texture_words": []}' % ("x" * 65), "no word"),
        ('{"words": ["\\ud800"], "texture_words": []}', "no word"),
        ('{"words": ["30"], "texture_words": []}', "no word"),
        ('{"words": ["a"], "texture_words": ["b"]}', "lacks its texture word 'b'"),
        ('{"words": [1], "texture_words": []}', "lists of text"),
        ('{"words": ["a"]}', "with the keys"),
        ('{"words": [', "no valid JSON"),
        (json.dumps({"words": ["a"] * 20001, "texture_words": []}), "20001 words"),
        (" " * 2**23, "more than"),
    ],
    ids=lambda value: value[:24],
)
def test_a_damaged_vocabulary_is_refused(content: str, reason: str, tmp_path) -> None:
    (tmp_path / VOCABULARY_FILE).write_text(content, encoding="utf-8")
    with pytest.raises(InputFileError, match=reason) as error:
        Vocabulary.read(tmp_path)
    assert str(error.value).isprintable() and len(str(error.value)) < 600
