"""Sizes of a VIMA policy, as a frozen record that checks itself and travels beside the weights."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, get_args, get_type_hints

from openvima.errors import ConfigError
from openvima.policies.layers.decoder import DecoderConfig
from openvima.policies.layers.object_encoder import ObjectEncoderConfig
from openvima.policies.layers.text_encoder import TextEncoderConfig
from openvima.policies.vima.heads.bins import BinsConfig
from openvima.policies.vima.heads.pointing import PointingConfig


@dataclass(frozen=True, slots=True)
class VimaConfig:
    """All sizes of the network.

    Args:
        objects: Object encoder; its token width is the decoder's.
        text: Prompt encoder.
        decoder: Decoder.
        prompt_object_width: Hidden width of the stack that takes object tokens into the prompt.
        action_width: Width of the features of each part of a past action.
        vocabulary_size: Number of word ids.
        pointing: Pointing head, or None.
        bins: Bins head, or None. Exactly one head is given.
        query_token: Append a learned token to each step's objects and act from there; without it the policy
            acts from its last object, as the published ones do.
    """

    objects: ObjectEncoderConfig
    text: TextEncoderConfig
    decoder: DecoderConfig
    prompt_object_width: int
    action_width: int
    vocabulary_size: int
    pointing: PointingConfig | None = None
    bins: BinsConfig | None = None
    query_token: bool = False

    def __post_init__(self) -> None:
        if (self.pointing is None) == (self.bins is None):
            raise ConfigError("policy: give exactly one action head, either pointing or bins.")
        if self.objects.width != self.decoder.width:
            raise ConfigError(
                f"policy: object tokens are {self.objects.width} wide, the decoder {self.decoder.width}; "
                "make them equal."
            )
        if self.pointing and not (self.objects.fuse_views and self.objects.appearance_width):
            raise ConfigError("policy: the pointing head needs fuse_views and an appearance width above 0.")

    def to_dict(self) -> dict[str, Any]:  # Any: plain YAML values
        """Return nested dictionaries of plain values, for files."""
        return asdict(self)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "VimaConfig":
        """Build a config from what `to_dict` returned.

        Raises:
            ConfigError: A field is missing or unknown, or the sizes contradict each other.
        """
        return _build(VimaConfig, values, "policy")


def _build(kind: type, values: Any, where: str) -> Any:  # Any: dataclasses of several kinds
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where} is {values!r}; it must be a mapping of the fields of {kind.__name__}.")
    hints = get_type_hints(kind)
    names = [field.name for field in fields(kind)]
    unknown = [str(name) for name in values if name not in names]
    if unknown:
        raise ConfigError(f"{where} has unknown fields {', '.join(unknown)}; allowed: {', '.join(names)}.")
    arguments = {name: _value(hints[name], value, f"{where}.{name}") for name, value in values.items()}
    try:
        return kind(**arguments)
    except TypeError as error:
        raise ConfigError(f"{where}: {error}.") from error


def _value(hint: Any, value: Any, where: str) -> Any:  # Any: a type as written in the dataclass
    if isinstance(hint, UnionType):
        if value is None:
            return None
        options = [option for option in get_args(hint) if option is not NoneType]
        hint = max(options, key=lambda option: _num_shared_fields(option, value))
    return _build(hint, value, where) if is_dataclass(hint) and isinstance(hint, type) else value


def _num_shared_fields(kind: Any, value: Any) -> int:  # Any: a type as written in the dataclass
    """How well the fields of a record fit a mapping; tells apart the records that a field may hold."""
    if not is_dataclass(kind) or not isinstance(value, Mapping):
        return 0
    names = {field.name for field in fields(kind)}
    return len(names & set(value)) - len(names ^ set(value))
