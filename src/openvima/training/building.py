"""Builds the learner of a run: the network of a preset with the vocabulary of the data, or your own one."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict, replace

import pyarrow as pa
import pyarrow.compute as pc
import torch

from openvima.data.reader import Dataset
from openvima.errors import ConfigError, differences
from openvima.perception.preprocessing import split_prompt
from openvima.policies.build import PolicyConfig, build_network, config_to_dict
from openvima.policies.checkpoint import load_network
from openvima.policies.naming import find_checkpoint
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.presets import PRESETS, own_policies, preset
from openvima.policies.processor import Processor
from openvima.policies.sizes import t5_name
from openvima.policies.t5 import load_t5, tokenizer_for
from openvima.policies.tokenizer import Vocabulary, WordTokenizer
from openvima.policies.variants import image_tokens, with_variant
from openvima.scene import ObjectRecord
from openvima.tasks.novel_words import NOUNS
from openvima.tasks.prompts import description_of, synonyms, training_paraphrases
from openvima.training.augmentation.prompts import DEFINITION, motion_text, text_of
from openvima.training.config import (
    DETECTED_PROB,
    PRETRAINING_STEPS,
    AugmentationConfig,
    TrainingConfig,
    flatten,
)
from openvima.training.learner import Learner, PolicyLearner, make_learner
from openvima.training.loop import step_seed
from openvima.training.pretraining.stage import caption_texts
from openvima.user_code import with_absolute_path

_FOR_OBJECTS = (
    "centre_picks",
    "drop_unused_objects_prob",
    "rename_objects_prob",
    "distractor_prob",
)


def resolve(config: TrainingConfig) -> TrainingConfig:
    """Fill in settings that depend on the preset, and check them against it.

    Raises:
        ConfigError: Settings contradict the preset.
    """
    if config.preset not in PRESETS:
        config = replace(config, preset=own_policies().get(config.preset, config.preset))
    repeats = ",".join(f"{name}={count}" for name, count in sorted(config.loader.repeats.items()))
    excluded = ",".join(config.loader.excluded_tasks)
    loader = replace(config.loader, exclude_tasks=excluded, repeat_tasks=repeats)
    config, augmentation = replace(config, loader=loader), config.augmentation
    if loader.detected_prob and loader.boxes is None:
        raise ConfigError(
            f"loader.detected_prob is {loader.detected_prob:g}, but no detector is given; name one with "
            "loader.boxes, such as 'detector'."
        )
    if loader.boxes is not None and augmentation.drop_unused_objects_prob:
        raise ConfigError(
            f"augmentation.drop_unused_objects_prob is {augmentation.drop_unused_objects_prob:g} and "
            f"loader.boxes {loader.boxes!r}; detected objects have no ids, so unused ones are unknown. Leave "
            "out either."
        )
    if loader.boxes is not None and loader.detected_prob is None:
        config = replace(config, loader=replace(loader, detected_prob=DETECTED_PROB))
    if loader.boxes is not None and loader.detected_fraction < 1 and config.loader.detected_prob == 1:
        raise ConfigError(
            f"loader.detected_fraction is {loader.detected_fraction:g}, but loader.detected_prob 1 leaves no "
            "true boxes for the other demonstrations; lower the latter, or set the former to 1."
        )
    if (total := (config.loader.detected_prob or 0.0) + loader.rerendered_prob) > 1:
        raise ConfigError(
            f"loader.detected_prob and loader.rerendered_prob are {total:g} together; at most 1 is allowed. "
            "Lower either."
        )
    if ":" in config.preset:
        return _for_own_learner(config)
    sizes = _sizes(config)
    needs_t5 = sizes.prompt.tokenizer == "t5"
    if needs_t5 and config.t5 is None and config.init_from is None:
        raise ConfigError(
            f"preset {config.preset!r} encodes prompts with T5; set t5 to the folder that holds "
            f"{t5_name(sizes.prompt.text)}, or to its name to fetch it from the Hugging Face Hub, or set "
            "model.text_encoder to 'small', which needs no files."
        )
    if config.t5 is not None and not needs_t5:
        raise ConfigError(
            f"preset {config.preset!r} has its own vocabulary and no T5; leave t5 out, or set "
            "model.text_encoder to a T5."
        )
    for_objects = {f"augmentation.{name}": getattr(augmentation, name) for name in _FOR_OBJECTS}
    for name, value in {**for_objects, "pretraining.steps": config.pretraining.steps}.items():
        if value and sizes.inputs.tokens == "frames":
            raise ConfigError(
                f"{name} is {value}, but preset {config.preset!r} takes whole frames, as "
                f"{image_tokens(sizes)!r}; leave it out, or take a preset that takes objects."
            )
    if config.pretraining.steps is None:
        has_appearance = getattr(sizes.images, "appearance_width", 0) > 0
        steps = PRETRAINING_STEPS if has_appearance and not config.init_from else 0
        config = replace(config, pretraining=replace(config.pretraining, steps=steps))
    if (
        config.pretraining.finetune_crop_encoder is False
        and not (config.pretraining.steps or config.init_from or config.crops_from)
        and sizes.inputs.tokens != "frames"
    ):
        raise ConfigError(
            "pretraining.finetune_crop_encoder is False, but nothing has trained the crop encoder; set "
            "pretraining.steps, crops_from or init_from, or train it with pretraining.finetune_crop_encoder "
            "True."
        )
    attributes, weight = getattr(sizes, "attributes", None), config.pretraining.attribute_loss_weight
    if weight and not attributes:
        raise ConfigError(
            f"pretraining.attribute_loss_weight is {weight:g}, but the network compares no attributes; set "
            "model.attributes, or leave the weight out."
        )
    if attributes and config.pretraining.steps and not weight:
        raise ConfigError(
            "pretraining.attribute_loss_weight is 0, so the network's attributes would stay random; give a "
            "weight such as 0.5, or set model.attributes to False."
        )
    return config


def _for_own_learner(config: TrainingConfig) -> TrainingConfig:
    augmentation = flatten(asdict(config.augmentation), "augmentation")
    augmentation.pop("augmentation.false_positive_prob")  # ignored unless its collator uses it
    given = {
        "pretraining.steps": config.pretraining.steps,
        **flatten(asdict(config.model), "model"),
        "crops_from": config.crops_from,
        "t5": config.t5,
        **augmentation,
    }
    if unknown := [name for name, value in given.items() if value]:
        raise ConfigError(f"a learner of your own does not know {' or '.join(unknown)}; leave it out.")
    preset = with_absolute_path(config.preset)  # the run folder names it to evaluations in other folders
    return replace(config, preset=preset, pretraining=replace(config.pretraining, steps=0))


def _sizes(config: TrainingConfig) -> PolicyConfig:
    """Return the config of the preset with its overrides."""
    return with_variant(preset(config.preset), asdict(config.model))


def build_learner(config: TrainingConfig, texts: Iterable[str] = ()) -> Learner:
    """Build the learner of a run, with fresh weights or those of `init_from`.

    Args:
        config: All settings, `resolve`.
        texts: Of the prompts. Their words are the vocabulary of networks without T5, or extend that of
            `init_from`.

    Raises:
        InputFileError: T5 or the initial weights are not where the settings say.
        ConfigError: The initial weights are those of a network of other sizes, or lack a tokenizer; or the
            crop encoder is of another size than that of `crops_from`.
        PromptError: The texts have too many different words, or one that T5 lacks.
        MissingExtraError: The preset encodes prompts with T5, and a package for that is not installed.
    """
    if ":" in config.preset:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(step_seed(config.seed, "weights", 0))
            learner = make_learner(config.preset)
        if config.init_from:
            learner.read(find_checkpoint(config.init_from))
        return learner
    sizes, initial, stored = _sizes(config), None, None
    if config.init_from:
        initial, stored = load_network(config.init_from)
        sizes = _compare_like(sizes, initial.config)
        _check_sizes(sizes, initial.config, config.init_from)
        sizes = replace(sizes, prompt=initial.config.prompt)
    if sizes.prompt.tokenizer == "t5":
        where = config.t5 or stored
        if where is None:
            raise ConfigError(
                f"init_from is {config.init_from}, with which no tokenizer of T5 is stored; set t5, too, to "
                "the folder that holds it, or to 't5-base'. Its weights are then not read."
            )
        tokenizer = tokenizer_for(sizes.prompt, where)
        for text in texts:  # a word that T5 lacks is named before the first step
            tokenizer.encode(text)
    else:
        known = Vocabulary() if stored is None else Vocabulary.read(stored)
        tokenizer = WordTokenizer(known.extended(texts))
        size = tokenizer.vocabulary.size_for(sizes.prompt.vocabulary_size)
        sizes = replace(sizes, prompt=replace(sizes.prompt, vocabulary_size=size))
    network = build_network(sizes, seed=step_seed(config.seed, "weights", 0))
    if initial is not None:
        _copy_weights(initial, network)
    elif config.t5:
        load_t5(network, config.t5)
    if config.crops_from:
        _copy_crop_encoder(config.crops_from, network)
    return PolicyLearner(network, Processor(*sizes.inputs, tokenizer), config.augmentation)


def _compare_like(ours: PolicyConfig, theirs: PolicyConfig) -> PolicyConfig:
    """Compare attributes as the weights to begin with have learned to, which is no matter of size."""
    here, there = (getattr(sizes, "attributes", None) for sizes in (ours, theirs))
    return replace(ours, attributes=replace(here, exclusive=there.exclusive)) if here and there else ours


def _check_sizes(ours: PolicyConfig, theirs: PolicyConfig, source: str) -> None:
    """Check that a network can begin with the weights of another, whose vocabulary may have another size."""
    here, there = flatten(config_to_dict(ours)), flatten(config_to_dict(theirs))
    for sizes in (here, there):
        sizes.pop("points", None)  # its two vectors may begin anew
    if ours.prompt.tokenizer == theirs.prompt.tokenizer == "words":
        here.pop("prompt.vocabulary_size")
        there.pop("prompt.vocabulary_size")
    if here["architecture"] != there["architecture"]:
        here, there = ({"architecture": sizes["architecture"]} for sizes in (here, there))  # says it all
    if differing := differences(there, here):
        raise ConfigError(
            f"init_from is {source}, a network of other sizes: {'; '.join(differing)}. Give the preset that "
            "it was trained with, and the same settings of the model."
        )


def _copy_weights(initial: PolicyNetwork, network: PolicyNetwork) -> None:
    """Copy all weights; further embeddings of words, and kinds of places that the other lacks, stay fresh."""
    weights, fresh = initial.state_dict(), network.state_dict()
    for name in ("prompt.words.weight", "attributes.words.weight"):
        if name in weights:
            fresh[name][: len(weights[name])] = weights[name]
            weights[name] = fresh[name]
    network.load_state_dict({name: weights.get(name, tensor) for name, tensor in fresh.items()})


def _copy_crop_encoder(source: str, network: PolicyNetwork) -> None:
    """Copy the crop encoder of other weights, which may be those of another architecture."""
    theirs, ours = load_network(source)[0].object_encoder, network.object_encoder
    if theirs is None or ours is None:
        raise ConfigError(
            f"crops_from is {source!r}, but {'it' if theirs is None else 'the preset'} takes whole frames; "
            "leave it out."
        )
    if ours.config.appearance_width:
        raise ConfigError(
            f"crops_from is {source!r}, but the preset matches objects by an embedding, which only its own "
            "pretraining teaches; leave it out."
        )
    if theirs.config.crop != ours.config.crop:
        raise ConfigError(
            f"crops_from is {source!r}, whose crop encoder is {theirs.config.crop}; that of the preset is "
            f"{ours.config.crop}. Leave it out, or take a preset of the same size."
        )
    ours.crop_encoder.load_state_dict(theirs.crop_encoder.state_dict())


def training_texts(
    dataset: Dataset, augmentation: AugmentationConfig, *, with_captions: bool = False
) -> Iterator[str]:
    """Read the different texts between the placeholders of the prompts, and those of the augmentation.

    Args:
        dataset: The demonstrations; of these only the prompts are read.
        augmentation: Settings, some of which bring words of their own.
        with_captions: Also yield the words of captions of attributes.

    Raises:
        DatasetError: A shard is damaged.
    """
    prompts: set[str] = set()
    for table in _tables(dataset, "prompt"):  # 0.1 ms per demonstration
        prompts.update(table.column("prompt").unique().to_pylist())
    if augmentation.inverse_dynamics_prob:
        prompts.add(motion_text(1))
    if augmentation.describes_objects:
        descriptions = _descriptions(dataset)
        prompts.update(map(text_of, descriptions))
        if augmentation.synonym_prob:
            prompts.update(text_of(other) for each in descriptions for other in synonyms(each))
    if augmentation.paraphrase_prob:
        tasks = set(dataset.index.column("task").to_pylist())
        prompts.update(text for task in tasks for text in training_paraphrases().get(task, ()))
    if augmentation.rename_objects_prob:
        prompts.update(DEFINITION.format(noun=f"the {noun}", image="") for noun in NOUNS)
    if with_captions:
        yield from caption_texts()
    for prompt in prompts:
        yield from (piece for piece in split_prompt(prompt) if isinstance(piece, str))


def _tables(dataset: Dataset, column: str) -> Iterator[pa.Table]:
    """Read a column of all demonstrations, shard by shard."""
    for name in dataset.shard_names():
        table = dataset.shard(name).table(["task", column])
        # A shard may also hold tasks that the data set leaves out.
        yield table if dataset.tasks is None else table.filter(pc.field("task").isin(dataset.tasks))


def _descriptions(dataset: Dataset) -> set[str]:
    """Return the different descriptions of objects in object images."""
    names = set()
    for table in _tables(dataset, "prompt_images"):
        images = pa.Table.from_struct_array(table.column("prompt_images").combine_chunks().flatten())
        shown = images.filter(pc.field("kind") == "object").column("objects").combine_chunks().flatten()
        records = pa.Table.from_struct_array(shown).select(["object", "texture"])
        different = records.group_by(["object", "texture"]).aggregate([]).to_pylist()
        names.update((record["object"], record["texture"]) for record in different)
    return {description_of(ObjectRecord(0, *each)) for each in names} - {""}
