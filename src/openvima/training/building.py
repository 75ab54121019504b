"""What a run trains: the network of a preset, with parts switched on or off, or a learner of one's own."""

from dataclasses import replace
from pathlib import Path

import torch

from openvima.errors import ConfigError
from openvima.policies.base import find_checkpoint
from openvima.policies.checkpoint import load_network
from openvima.policies.config import PolicyConfig
from openvima.policies.families.midas import with_autoregression, with_visual_residual
from openvima.policies.inputs import Reader
from openvima.policies.network import PolicyNetwork, build_network
from openvima.policies.nn.object_encoder import ObjectEncoderConfig
from openvima.policies.presets import preset
from openvima.policies.t5 import load_t5, tokenizer_for
from openvima.training.config import DETECTED_SHARE, MATCHING_STEPS, TrainingConfig
from openvima.training.learner import Learner, PolicyLearner, make_learner
from openvima.training.retelling import Retelling
from openvima.training.run_folder import flattened
from openvima.training.schedule import step_seed

# Settings that only networks of this package have.
_OF_PRESETS = (
    "pretraining_steps",
    "t5",
    "motion_share",
    "bystander_share",
    "naming_share",
    "reordering_share",
    "stranger_share",
    "autoregressive",
    "visual_residual",
)


def resolved(config: TrainingConfig) -> TrainingConfig:
    """Fill in what the settings leave to the preset, and check that both fit together.

    Raises:
        ConfigError: They do not.
    """
    if config.detected_share and config.boxes is None:
        raise ConfigError(
            f"detected_share is {config.detected_share:g}, but no detector is given; name one with boxes, "
            "such as 'detector'."
        )
    if config.boxes is not None and config.bystander_share:
        raise ConfigError(
            f"bystander_share is {config.bystander_share:g} and boxes {config.boxes!r}; found objects "
            "have no ids that tell bystanders. Leave out either."
        )
    if config.boxes is not None and config.detected_share is None:
        config = replace(config, detected_share=DETECTED_SHARE)
    if ":" in config.preset:
        unknown = [name for name in _OF_PRESETS if getattr(config, name)]
        if unknown:
            raise ConfigError(f"a learner of your own does not know {' or '.join(unknown)}; leave it out.")
        return replace(config, pretraining_steps=0)
    sizes = _sizes(config)
    reads_with_t5, images = sizes.prompt.tokenizer == "t5", sizes.images
    if reads_with_t5 and config.t5 is None and config.init is None:
        raise ConfigError(
            f"preset {config.preset!r} reads prompts with T5; set t5 to the folder that holds it, or to "
            "'t5-base' to fetch that from the Hugging Face Hub, or take nano or another preset of that size."
        )
    if config.t5 is not None and not reads_with_t5:
        raise ConfigError(f"preset {config.preset!r} has its own words and no T5; leave t5 out.")
    for name in ("bystander_share", "naming_share", "stranger_share"):
        if getattr(config, name) and not isinstance(images, ObjectEncoderConfig):
            raise ConfigError(
                f"{name} is {getattr(config, name):g}, but preset {config.preset!r} sees whole frames; it "
                "needs one that sees objects."
            )
    has_appearance = isinstance(images, ObjectEncoderConfig) and images.appearance_width
    if config.pretraining_steps and not has_appearance:
        raise ConfigError(
            f"pretraining_steps is {config.pretraining_steps}, but preset {config.preset!r} has no "
            "appearance embedding to match prompt and scene with; leave it out, or set it to 0."
        )
    if config.pretraining_steps is None:
        return replace(config, pretraining_steps=MATCHING_STEPS if has_appearance and not config.init else 0)
    return config


def _sizes(config: TrainingConfig) -> PolicyConfig:
    """The sizes of the preset, with what is switched on or off."""
    sizes = preset(config.preset)
    if config.autoregressive is not None:
        sizes = with_autoregression(sizes, config.autoregressive)
    if config.visual_residual is not None:
        sizes = with_visual_residual(sizes, config.visual_residual)
    return sizes


def build_learner(config: TrainingConfig) -> Learner:
    """Build what a run trains, with fresh weights or with those it begins with.

    Args:
        config: All settings, as `resolved` returned them.

    Raises:
        CheckpointError: T5 or the weights to begin with are not where the settings say.
        ConfigError: The weights to begin with are those of a network of other sizes, or lack a tokenizer.
        MissingExtraError: The preset reads prompts with T5, and a package for that is not installed.
    """
    if ":" in config.preset:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(step_seed(config.seed, "weights", 0))
            learner = make_learner(config.preset)
        if config.init:
            learner.read(find_checkpoint(config.init))
        return learner
    sizes, stored = _sizes(config), None
    network = build_network(sizes, seed=step_seed(config.seed, "weights", 0))
    if config.init:
        stored = _begin_with(network, config.init)
    elif config.t5:
        load_t5(network, config.t5)
    where = config.t5 or stored
    if sizes.prompt.tokenizer == "t5" and where is None:
        raise ConfigError(
            f"init is {config.init}, with which no tokenizer of T5 is stored; set t5, too, to the folder "
            "that holds it, or to 't5-base'. Its weights are then not read."
        )
    reader = Reader.of(sizes.images, tokenizer_for(sizes.prompt, where))
    return PolicyLearner(
        network,
        reader,
        spurious_probability=config.spurious_probability,
        retelling=Retelling(
            motion_share=config.motion_share,
            bystander_share=config.bystander_share,
            naming_share=config.naming_share,
            reordering_share=config.reordering_share,
        ),
    )


def _begin_with(network: PolicyNetwork, source: str) -> Path | None:
    """Copy the weights of another network, and return the folder of its tokenizer, if it has one."""
    other, tokenizer = load_network(source)
    ours, theirs = flattened(network.config.to_dict()), flattened(other.config.to_dict())
    differing = [
        f"{name} is {theirs.get(name)!r} there and {ours.get(name)!r} here"
        for name in {**theirs, **ours}
        if theirs.get(name) != ours.get(name)
    ]
    if differing:
        raise ConfigError(
            f"init is {source}, a network of other sizes: {'; '.join(differing)}. Give the preset that it "
            "was trained with, and the same autoregressive and visual_residual."
        )
    network.load_state_dict(other.state_dict())
    return tokenizer
