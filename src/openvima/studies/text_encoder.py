"""What does the text encoder contribute: its size, and the number of layers that are trained?"""

from collections.abc import Mapping
from typing import Any

from openvima.errors import ConfigError
from openvima.studies.study import Run, Study, StudyInputs

T5_SIZES = ("t5-small", "t5-base", "t5-large")
TUNED_LAYERS = (0, 1, 2)


def text_encoder(inputs: StudyInputs) -> Study:
    """VIMA with text encoders of several sizes, and with different numbers of trained layers.

    At nano: the encoder of the network's own vocabulary, with some or all layers trained.
    """
    return Study(
        name="text-encoder",
        question="How much text encoder is needed, and how much of it must be trained?",
        quantity="text encoder",
        data=inputs.demonstrations(),
        runs=_own(inputs) if inputs.scale.is_nano else _t5(inputs),
        evaluation=inputs.evaluation(),
        notes=(
            "A text encoder of its own vocabulary starts from random weights: frozen layers stay random.",
        ),
    )


def _own(inputs: StudyInputs) -> tuple[Run, ...]:
    layers: dict[str, Mapping[str, Any]] = {"all layers trained": {}}
    layers |= {f"{count} trained": {"model.tuned_layers": count} for count in (1, 0)}
    return tuple(
        Run(f"small, {name}", settings={**inputs.network("vima"), **settings})
        for name, settings in layers.items()
    )


def _t5(inputs: StudyInputs) -> tuple[Run, ...]:
    """T5 of all sizes from the Hub, or from folders of these names in `--t5`; tuned layers of T5-base."""
    where = inputs.needed_t5()
    if where.rstrip("/").endswith(T5_SIZES) and "/" in where:
        raise ConfigError(
            f"--t5 is {where!r}; this study needs several sizes: give the folder that holds "
            f"{', '.join(T5_SIZES)}, or 't5-base' to fetch them from the Hugging Face Hub."
        )
    sources = {size: size if where in T5_SIZES else f"{where}/{size}" for size in T5_SIZES}
    vima = {"preset": f"vima-{inputs.scale.name}"}
    runs = [
        Run(size, settings={**vima, "model.text_encoder": size, "t5": source})
        for size, source in sources.items()
    ]
    base = {**vima, "model.text_encoder": "t5-base", "t5": sources["t5-base"]}
    runs += [Run(f"t5-base, {n} tuned", settings={**base, "model.tuned_layers": n}) for n in TUNED_LAYERS]
    return (*runs, Run("small", settings={**vima, "model.text_encoder": "small"}))
