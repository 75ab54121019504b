"""Configs of all architectures, as validated frozen dataclasses."""

from collections.abc import Mapping
from dataclasses import asdict
from reprlib import repr as short
from typing import Any, get_args

from openvima.errors import ConfigError, unknown_name
from openvima.policies.config_fields import build_config
from openvima.policies.flamingo.config import FlamingoConfig
from openvima.policies.gato.config import GatoConfig
from openvima.policies.gpt.config import GptConfig
from openvima.policies.midas.config import MidasConfig
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.pointer.config import PointerConfig
from openvima.policies.vima.config import VimaConfig

PolicyConfig = VimaConfig | GatoConfig | FlamingoConfig | GptConfig | MidasConfig | PointerConfig
ARCHITECTURES: dict[str, type[PolicyConfig]] = {kind.architecture: kind for kind in get_args(PolicyConfig)}


def config_to_dict(config: PolicyConfig) -> dict[str, Any]:  # Any: plain YAML values
    """Convert to nested dictionaries of plain values, the architecture first."""
    return {"architecture": config.architecture, **asdict(config)}


def config_from_dict(values: Mapping[str, Any]) -> PolicyConfig:  # Any: whatever a file holds
    """Inverse of `config_to_dict`.

    Raises:
        ConfigError: A field is missing or unknown, or sizes are inconsistent.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"policy is {short(values)}; it must be a mapping of architecture and sizes.")
    architecture = values.get("architecture")
    if not isinstance(architecture, str) or architecture not in ARCHITECTURES:
        raise ConfigError(unknown_name("architecture", short(architecture).strip("'"), ARCHITECTURES))
    sizes = {name: value for name, value in values.items() if name != "architecture"}
    return build_config(ARCHITECTURES[architecture], sizes, "policy")


def appearance_width(config: PolicyConfig) -> int:
    """Length of the appearance embedding; 0 for networks without one."""
    images = config.images
    return images.appearance_width if isinstance(images, ObjectEncoderConfig) else 0
