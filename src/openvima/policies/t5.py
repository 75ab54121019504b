"""The T5 tokenizer and the pretrained weights of the T5 encoder.

Both come from a local folder in the format of transformers' `save_pretrained`, or from the Hugging Face Hub.
Nothing is downloaded unless an id is given.
"""

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from openvima.errors import InputFileError, PolicyError, PromptError, echo
from openvima.hub import HubName, fetch, hub_name
from openvima.imports import import_extra
from openvima.input_files import as_path, read_text
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.published import T5, T5_RULES, to_ours
from openvima.policies.sizes import t5_name
from openvima.policies.tensor_files import mismatches, read_safetensors
from openvima.policies.tokenizer import END_ID, PADDING_ID, UNKNOWN, Tokenizer, Vocabulary, WordTokenizer

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerFast

_UNKNOWN_ID = 2
_WORD_START = "▁"  # T5 marks the beginning of a word with it
_OWNERLESS = re.compile(
    r"([A-Za-z0-9][\w.-]*)(?:@([A-Za-z0-9][\w.-]*))?"
)  # T5 may be named without its owner
_TOKENIZER_FILES = ("tokenizer.json", "tokenizer_config.json", "special_tokens_map.json")
_WEIGHTS_FILE = "model.safetensors"
_MAX_TOKENIZER_BYTES = 16 * 2**20  # of each file; those of t5-base have up to 1.4 MB
_MAX_WORDS = 2**16  # words whose pieces are kept


class T5Tokenizer:
    """The T5 tokenizer, loaded through transformers.

    Every word is encoded separately with the word-start marker. A full stop after a placeholder becomes "▁"
    and ".", and no marker is left before a placeholder, as in the published policies. "<unknown>" becomes the
    unknown token. Versions of transformers differ in how they split whole texts, but not single words.

    Args:
        path_or_hub_id: A folder with `tokenizer.json`, or a name on the Hugging Face Hub such as "t5-base".

    Raises:
        InputFileError: There is no such tokenizer, or it is not a T5 tokenizer.
        MissingExtraError: A required package is not installed.
    """

    texture_ids = np.zeros(0, np.int64)  # its pieces of words describe no appearance alone

    def __init__(self, path_or_hub_id: str | Path) -> None:
        self._tokenizer = _read_tokenizer(path_or_hub_id)
        self._special_ids = frozenset(self._tokenizer.all_special_ids)
        self._words: dict[str, list[int]] = {}  # prompts repeat a few hundred words over and over

    @property
    def vocabulary_size(self) -> int:
        """Number of ids that `encode` may return."""
        return self._tokenizer.backend_tokenizer.get_vocab_size(with_added_tokens=False)

    def encode(self, text: str) -> list[int]:
        """Encode text without placeholders; no end token is added.

        Raises:
            PromptError: A word is not in the vocabulary of T5.
        """
        words = text.replace(UNKNOWN, f" {UNKNOWN} ").split()
        unknown = [
            word
            for word in words
            if word != UNKNOWN and not self._special_ids.isdisjoint(self._encode_word(word))
        ]
        if unknown:
            shown = ", ".join(repr(word) for word in dict.fromkeys(unknown))
            raise PromptError(
                f"the prompt text {echo(repr(text), 100)} contains {echo(shown, 100)}, which the vocabulary "
                "of T5 lacks. Write it in other letters, without special tokens."
            )
        return [piece for word in words for piece in self._encode_word(word)]

    def save(self, folder: str | Path) -> None:
        """Write the tokenizer files to a folder, for `T5Tokenizer` to load."""
        self._tokenizer.save_pretrained(str(folder))

    def _encode_word(self, word: str) -> list[int]:
        if word == UNKNOWN:  # masked on purpose
            return [_UNKNOWN_ID]
        if word not in self._words:
            if len(self._words) >= _MAX_WORDS:
                self._words.clear()
            backend = self._tokenizer.backend_tokenizer
            self._words[word] = backend.encode(word, add_special_tokens=False).ids
        return self._words[word]


def tokenizer_for(config: PromptEncoderConfig, source: str | Path | None = None) -> Tokenizer:
    """Return the tokenizer of a prompt encoder.

    Args:
        config: The prompt encoder.
        source: Folder of the stored tokenizer; for T5, also its Hub id, see `T5Tokenizer`. Without one,
            networks with a vocabulary have that of the benchmark.

    Raises:
        PolicyError: The T5 tokenizer is needed and no source is given, or the network has fewer word
            embeddings.
        InputFileError: The source has no such tokenizer.
        MissingExtraError: A required package is not installed.
    """
    tokenizer: Tokenizer
    if config.tokenizer == "words":
        tokenizer = WordTokenizer(None if source is None else Vocabulary.read(Path(source)))
        num_ids = tokenizer.vocabulary.num_ids
    elif source is not None:
        tokenizer = T5Tokenizer(source)
        num_ids = tokenizer.vocabulary_size
    else:
        raise PolicyError(
            "this policy needs the tokenizer of T5, which is not stored with it. Give it as "
            "tokenizer=T5Tokenizer(FOLDER), or store it: `openvima policies convert IN OUT --tokenizer "
            "FOLDER`; 't5-base' instead of a folder fetches it from the Hugging Face Hub."
        )
    if num_ids > config.vocabulary_size:
        raise PolicyError(
            f"the vocabulary of {source or 'the benchmark'} has {num_ids} ids, the policy "
            f"{config.vocabulary_size}; use the tokenizer of the policy."
        )
    return tokenizer


def load_t5(network: PolicyNetwork, path_or_hub_id: str | Path) -> None:
    """Copy the word embedding and the encoder of T5 into a network's prompt encoder.

    Args:
        network: Its text encoder must match the file in size; that of the published presets is t5-base.
        path_or_hub_id: A folder with `model.safetensors`, or a name on the Hugging Face Hub such as
            "t5-base".

    Raises:
        InputFileError: There are no such weights, they are damaged, or their names or sizes differ.
        MissingExtraError: An id is given and huggingface_hub is not installed.
    """
    file = _folder(path_or_hub_id, (_WEIGHTS_FILE,)) / _WEIGHTS_FILE
    if not file.is_file():
        raise InputFileError(f"{path_or_hub_id} holds no {_WEIGHTS_FILE}.")
    tensors = {}  # without decoder and language model head
    for name, tensor in read_safetensors(file).items():
        if name in ("shared.weight", "encoder.embed_tokens.weight"):  # two names of one table
            tensors["prompt.words.weight"] = tensor
        elif name.startswith("encoder."):
            ours = to_ours(T5_RULES, T5 + name.removeprefix("encoder"))
            tensors[ours[0] if ours else name] = tensor
    kept = ("prompt.words.", "prompt.text.")
    expected = {name: own for name, own in network.state_dict().items() if name.startswith(kept)}
    if problems := mismatches(tensors, expected):
        raise InputFileError(
            f"{file} does not fit the text encoder: {'; '.join(problems)}. "
            f"It needs a T5 1.0: {t5_name(network.config.prompt.text)}."
        )
    for name, tensor in expected.items():
        tensor.copy_(tensors[name])


def _read_tokenizer(path_or_hub_id: str | Path) -> "PreTrainedTokenizerFast":
    folder = _folder(path_or_hub_id, _TOKENIZER_FILES)
    if not (folder / _TOKENIZER_FILES[0]).is_file():
        # Without this check transformers would return a vocabulary of special tokens only.
        raise InputFileError(f"{path_or_hub_id} holds no {_TOKENIZER_FILES[0]}.")
    for name in _TOKENIZER_FILES:
        if (folder / name).exists():
            read_text(folder / name, max_bytes=_MAX_TOKENIZER_BYTES)  # no pipe, and not much larger than T5's
    transformers = import_extra("transformers", "T5 needs transformers: pip install 'openvima[t5]'")
    try:
        tokenizer = transformers.T5TokenizerFast.from_pretrained(str(folder), local_files_only=True)
    except Exception as error:  # tokenizers raises no narrower one for a damaged file
        raise InputFileError(f"{path_or_hub_id} holds no tokenizer that can be read: {error}") from error
    ids = (tokenizer.pad_token_id, tokenizer.eos_token_id, tokenizer.unk_token_id)
    pieces = tokenizer.backend_tokenizer.encode("Put", add_special_tokens=False).tokens
    if ids != (PADDING_ID, END_ID, _UNKNOWN_ID) or not pieces[0].startswith(_WORD_START):
        raise InputFileError(
            f"the tokenizer of {path_or_hub_id} is not that of T5: padding, end and unknown are {ids} "
            f"instead of {(PADDING_ID, END_ID, _UNKNOWN_ID)}, or words do not begin with {_WORD_START!r}."
        )
    return tokenizer


def _folder(path_or_hub_id: str | Path, files: tuple[str, ...]) -> Path:
    """The folder itself; for a Hub id, the folder of the downloaded files."""
    folder, name = as_path(path_or_hub_id), str(path_or_hub_id)
    if folder.is_dir():
        return folder
    repository = hub_name(name)
    if repository is None and (ownerless := _OWNERLESS.fullmatch(name)):
        repository = HubName(*ownerless.groups())
    if folder.exists() or repository is None:
        raise InputFileError(f"{name} is no folder, and no name on the Hugging Face Hub such as 't5-base'.")
    return fetch(repository, files)
