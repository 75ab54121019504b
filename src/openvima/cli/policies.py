"""`openvima policies`: list networks and trained policies, show one, convert, export and push checkpoints."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from openvima.cli.terminal import (
    Out,
    Policy,
    Repository,
    print_files,
    print_table,
    refuse_existing,
)
from openvima.errors import UnknownPolicyError
from openvima.policies.base import require_torch
from openvima.policies.naming import (
    BUNDLED,
    MODEL_CARD,
    WEIGHTS_FILE,
    PolicyRef,
    find_checkpoint,
    unknown_policy,
)
from openvima.policies.presets import PRESETS, own_policies, preset

if TYPE_CHECKING:
    from openvima.policies.build import Count, PolicyConfig

Precision = Literal["float32", "bfloat16", "float16", "float64"]
_NOTES = (
    "layers: self-attention, in vima and flamingo with cross-attention to the prompt before it",
    "positions: position tables and learned tokens; images: with the fusion of end effector and image",
    "Sizes are named after the decoder parameters. `openvima policies show NAME` prints details.",
)
DEFAULT = "list"  # what `openvima policies` does without a further word


def list_() -> None:
    """List the presets with parameter counts by part, the bundled checkpoints, and learners of your own.

    Example: openvima policies
    """
    require_torch("counting parameters")
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from openvima.policies.build import PARTS, count_parameters, outline_network
    from openvima.policies.checkpoint import read_info

    table = Table(title="parameters in millions", box=SIMPLE_HEAD, padding=0, pad_edge=False, show_edge=False)
    for name in ("preset", "width", "layers", "heads", *PARTS, "total", "trained", "frozen"):
        table.add_column(name, justify="left" if name == "preset" else "right", no_wrap=True)
    for name in PRESETS:
        config = preset(name)
        counts, decoder = count_parameters(outline_network(config)), config.decoder
        totals = [count.total for count in counts.values()]
        millions = map(_millions, (*totals, counts["total"].trainable, counts["total"].frozen))
        table.add_row(name, str(decoder.width), str(decoder.num_layers), str(decoder.num_heads), *millions)
    print_table(table)
    print(*_NOTES, sep="\n")
    for name, folder in BUNDLED.items():
        total = count_parameters(outline_network(read_info(folder).config))["total"]
        print(f"\n{name}, a bundled checkpoint, {_millions(total.total)} M parameters")
        _print_facts(folder)
    for name, source in own_policies().items():
        print(f"\n{name}, a learner of your own, {source}")


def show(policy: Policy) -> None:
    """Show one policy: parameter counts by part, and its config.

    Example: openvima policies show vima-200m

    Args:
        policy: Name of a preset or of a bundled checkpoint, a run folder or checkpoint folder, a published
            file, or OWNER/NAME[@REVISION] on the Hugging Face Hub.
    """
    require_torch("counting parameters")
    import yaml

    from openvima.policies.build import config_to_dict, count_parameters, outline_network
    from openvima.policies.checkpoint import load_network, read_info

    if policy in PRESETS:
        config = preset(policy)
    elif not PolicyRef.parse(policy).has_weights:
        raise UnknownPolicyError(unknown_policy(policy, ()))
    else:
        found = find_checkpoint(policy)
        config = read_info(found).config if found.is_dir() else load_network(found)[0].config
    counts = count_parameters(outline_network(config))
    print(f"{policy}: {_summary(config, counts['total'])}")
    if policy in BUNDLED:
        _print_facts(BUNDLED[policy])
    print(f"\n{'part':<10}{'trained':>14}{'frozen':>14}{'total':>14}")
    for part, count in counts.items():
        print(f"{part:<10}{count.trainable:>14,}{count.frozen:>14,}{count.total:>14,}")
    print(f"\n{yaml.safe_dump(config_to_dict(config), sort_keys=False)}", end="")


def convert(
    source: Annotated[Positional[str], arg(metavar="IN")],
    out: Out,
    *,
    tokenizer: str | None = None,
    precision: Precision = "float32",
    force: bool = False,
) -> None:
    """Convert a published .ckpt file, or export the best checkpoint of a run, into a checkpoint folder.

    No code in a file is executed. With a checkpoint folder as IN, add a tokenizer, or change the precision of
    the stored weights.

    Examples: openvima policies convert 200M.ckpt published-200m --tokenizer t5-base;
    openvima policies convert runs/first mine --precision float16

    Args:
        source: Published file, such as 200M.ckpt, a run folder, of which the best checkpoint is used, a
            checkpoint folder, or a bundled checkpoint.
        out: Folder to write; every `--policy` option accepts it.
        tokenizer: Folder of the tokenizer of T5, or its id on the Hugging Face Hub; stored with the policy.
        precision: Of the stored weights. float16 halves the file size of float32, with a relative rounding
            error of 1/2,000; inference still runs in float64 or float32.
        force: Replace an existing checkpoint.
    """
    refuse_existing(out, force=force)
    require_torch("reading a policy")
    from openvima.policies.build import count_parameters
    from openvima.policies.checkpoint import load_network, save_checkpoint
    from openvima.policies.t5 import tokenizer_for

    network, stored = load_network(source)
    found = tokenizer or stored
    loaded_tokenizer = tokenizer_for(network.config.prompt, found) if found else None
    import torch

    save_checkpoint(network, out, loaded_tokenizer, dtype=getattr(torch, precision))
    print(f"{source}: {_summary(network.config, count_parameters(network)['total'])}")
    print(out)
    if network.config.prompt.tokenizer == "t5" and not found:
        hint = (
            "Stored without a tokenizer: convert again with --tokenizer, or give one whenever it is loaded."
        )
        print(hint, file=sys.stderr)


def push_to_hub(
    source: Annotated[Positional[str], arg(metavar="SOURCE")],
    name: Repository,
    *,
    results: Path | None = None,
    licence: str = "mit",
    private: bool = False,
    dry_run: bool = False,
) -> None:
    """Push a checkpoint to the Hugging Face Hub, with a generated model card.

    The token is that of `hf auth login` or HF_TOKEN. The card says what the run recorded of data and settings
    and, with --results, the scores of these very weights with their intervals.

    Example: openvima policies push-to-hub runs/first owner/first --results scores

    Args:
        source: A run folder, of which the best checkpoint is pushed, a checkpoint folder, or a bundled
            checkpoint.
        name: The repository, as OWNER/NAME or OWNER/NAME@BRANCH; it is created if there is none.
        results: Folder of an evaluation of these weights.
        licence: Identifier of the licence of the weights.
        private: Make a new repository private.
        dry_run: Print the card and list the files; nothing is sent.
    """
    from openvima.publishing import policy_files, push_policy

    if dry_run:
        print_files(policy_files(source, name, results=results, licence=licence))
    else:
        print(push_policy(source, name, results=results, licence=licence, private=private))


def _summary(config: "PolicyConfig", total: "Count") -> str:
    decoder = config.decoder
    layers = "1 layer" if decoder.num_layers == 1 else f"{decoder.num_layers} layers"
    return (
        f"{config.architecture}, width {decoder.width}, {layers}, {decoder.num_heads} heads; "
        f"{_millions(total.total)} M parameters, of which {_millions(total.trainable)} M are trained"
    )


def _print_facts(bundled: Path) -> None:
    print(f"  weights:     {(bundled / WEIGHTS_FILE).stat().st_size / 1e6:.1f} MB")
    print(f"  model card:  {bundled / MODEL_CARD}")


def _millions(count: int) -> str:
    return f"{count / 1e6:.2f}"


COMMANDS = {"list": list_, "show": show, "convert": convert, "push-to-hub": push_to_hub}
