"""How does success depend on the size of the network?"""

from openvima.policies.presets import PUBLISHED, SIZE_NAMES
from openvima.report.published import model_size_curves, size_ticks
from openvima.studies.study import Run, Study, StudyInputs, published_points

NANO_WIDTHS = (32, 64, 128)  # of the decoder of vima-nano


def model_scaling(inputs: StudyInputs) -> Study:
    """All architectures of the papers in all sizes up to that of the scale; at nano, widths of VIMA."""
    scale = inputs.scale
    runs = _widths(inputs) if scale.is_nano else _sizes(inputs)
    return Study(
        name="model-scaling",
        question="How does success depend on the size of the network?",
        quantity="width of the decoder" if scale.is_nano else "parameters of the controller",
        data=inputs.demonstrations(),
        runs=runs,
        evaluation=inputs.evaluation(),
        logarithmic=True,
        ticks={} if scale.is_nano else size_ticks(model_size_curves("L1")),
        published=() if scale.is_nano else published_points(scale.levels, model_size_curves),
        notes=(
            "Controller: the network without its text encoder; the table of costs counts all parameters.",
        ),
    )


def _widths(inputs: StudyInputs) -> tuple[Run, ...]:
    network = inputs.network("vima")
    return tuple(
        Run(f"width {width}", x=width, series="VIMA", settings={**network, "model.width": width})
        for width in NANO_WIDTHS
    )


def _sizes(inputs: StudyInputs) -> tuple[Run, ...]:
    sizes = SIZE_NAMES[1 : SIZE_NAMES.index(inputs.scale.name) + 1]
    return tuple(
        Run(
            f"{architecture}-{size}",
            x=1e6 * int(size.removesuffix("m")),
            series=architecture,
            settings={"preset": f"{architecture}-{size}", "t5": inputs.needed_t5()},
        )
        for architecture in PUBLISHED
        for size in sizes
    )
