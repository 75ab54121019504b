"""Sizes of a policy network, as a frozen record that checks itself and travels beside the weights."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, get_args, get_type_hints

from openvima.errors import ConfigError
from openvima.policies.heads.autoregressive import AutoregressiveConfig
from openvima.policies.heads.bins import BinsConfig
from openvima.policies.heads.copying import CopyingConfig
from openvima.policies.heads.pointing import PointingConfig
from openvima.policies.nn.comparison import ComparisonConfig
from openvima.policies.nn.frame_encoder import FrameEncoderConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.nn.prompt_encoder import PromptEncoderConfig
from openvima.policies.nn.trunk import DecoderConfig, PrefixConfig


@dataclass(frozen=True, slots=True)
class PolicyConfig:
    """All sizes of a network. The members of the family differ in `images` and `trunk`.

    Args:
        images: How images become tokens: object by object, or as whole frames.
        prompt: Prompt encoder.
        trunk: How the history is read in the light of the prompt.
        head: How actions are given: as table bins, as bins one after the other, by pointing, or by
            pointing with places to copy.
        action_width: Width of the features of each part of a past action; not used where each component is a
            token of its own.
        query_token: Append a learned token to each step's images and act from there; without it the policy
            acts from its last image token, as the published ones do.
        comparison: Compare objects with each other and with those of the prompt, and add to their tokens how
            they differ; None to leave them as they are.
    """

    images: ObjectEncoderConfig | FrameEncoderConfig
    prompt: PromptEncoderConfig
    trunk: DecoderConfig | PrefixConfig
    head: BinsConfig | AutoregressiveConfig | PointingConfig | CopyingConfig
    action_width: int
    query_token: bool = False
    comparison: ComparisonConfig | None = None

    def __post_init__(self) -> None:
        if self.images.width != self.trunk.width:
            raise ConfigError(
                f"policy: image tokens are {self.images.width} wide, the trunk {self.trunk.width}; "
                "make them equal."
            )
        images = self.images
        matches = isinstance(images, ObjectEncoderConfig) and images.fuse_views and images.appearance_width
        if isinstance(self.head, PointingConfig | CopyingConfig) and not (matches and self.query_token):
            name = "pointing" if isinstance(self.head, PointingConfig) else "copying"
            raise ConfigError(
                f"policy: the {name} head needs objects with fuse_views, an appearance width above 0 "
                "and a query token."
            )
        if self.comparison and not matches:
            raise ConfigError(
                "policy: comparison needs objects with fuse_views and an appearance width above 0."
            )

    def to_dict(self) -> dict[str, Any]:  # Any: plain YAML values
        """Return nested dictionaries of plain values, for files."""
        return asdict(self)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> "PolicyConfig":
        """Build a config from what `to_dict` returned.

        Raises:
            ConfigError: A field is missing or unknown, or the sizes contradict each other.
        """
        return _build(PolicyConfig, values, "policy")


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
        if value is None and NoneType in get_args(hint):
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
