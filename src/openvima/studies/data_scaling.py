"""How does success depend on the number of demonstrations?

Every fraction is trained for the same number of steps, and each training seed draws its own fraction.
"""

from openvima.report.published import data_fraction_curves
from openvima.studies.study import NANO_POINTER, Run, Study, StudyInputs, published_points

FRACTIONS = (0.001, 0.01, 0.1, 1.0)


def data_scaling(inputs: StudyInputs) -> Study:
    """Fractions of the demonstrations, as published for VIMA 92M and MIDAS 92M."""
    scale = inputs.scale
    network = NANO_POINTER if scale.is_nano else inputs.network("vima")
    return Study(
        name="data-scaling",
        question="How does success depend on the number of demonstrations?",
        quantity="fraction of the demonstrations",
        data=inputs.demonstrations(),
        # Too few demonstrations are held out of a small fraction to choose a checkpoint: the last one counts.
        settings={**network, "loader.validation_fraction": 0.0},
        runs=tuple(Run(_percent(f), x=f, data_fraction=f) for f in FRACTIONS),
        evaluation=inputs.evaluation(),
        logarithmic=True,
        ticks={fraction: _percent(fraction) for fraction in FRACTIONS},
        published=published_points(scale.levels, data_fraction_curves),
        notes=(
            f"100 % are {scale.demonstrations:,} demonstrations of each of {len(scale.tasks)} tasks here, "
            "and 50,000 of each of 13 in the papers.",
            "All fractions are trained for the same number of steps. A batch has no more demonstrations than "
            "there are, so those of small fractions are smaller.",
            "Contrastive pretraining, where the preset has it, uses rendered scenes and no demonstrations: "
            "it is the same for all fractions.",
        ),
    )


def _percent(fraction: float) -> str:
    return f"{100 * fraction:g} %"
