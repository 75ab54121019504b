"""What do autoregressive actions, visual residual and inverse-dynamics pretraining contribute to MIDAS?"""

from itertools import product

from openvima.report.published import published_models
from openvima.studies.study import PublishedPoint, Run, Settings, Study, StudyInputs

WITH, WITHOUT = "with pretraining", "without pretraining"
HEADS = ("autoregressive", "bins")
PRETRAINING_STEPS = 10_300  # the longest of the paper
_BOTH = "autoregressive, residual"  # the published model


def midas(inputs: StudyInputs) -> Study:
    """All eight combinations; runs with the same network share their pretraining."""
    network = inputs.network("midas")
    runs = []
    for head, residual, pretrained in product(HEADS, (True, False), (True, False)):
        name = f"{head}, {'residual' if residual else 'no residual'}"
        settings = {**network, "model.head": head, "model.visual_residual": residual}
        runs.append(
            Run(
                f"{name}, {WITH if pretrained else WITHOUT}",
                x=name,
                series=WITH if pretrained else WITHOUT,
                settings=settings,
                init=_pretraining(inputs, settings) if pretrained else None,
            )
        )
    return Study(
        name="midas",
        question="What do autoregressive actions, residual and pretraining contribute to MIDAS?",
        quantity="action head and visual residual",
        data=inputs.demonstrations(),
        runs=tuple(runs),
        evaluation=inputs.evaluation(),
        published=tuple(
            PublishedPoint(f"{model.model} 92M", _BOTH, level, rate / 100, model.mark(level))
            for model in published_models()
            if model.model.startswith("MIDAS") and (model.size, model.data_fraction) == ("92M", 1)
            for level, rate in model.levels.items()
        ),
        notes=("Pretraining adds steps: runs with it are trained for longer in all.",),
    )


def _pretraining(inputs: StudyInputs, settings: Settings) -> Settings:
    steps = {} if inputs.scale.is_nano else {"schedule.steps": PRETRAINING_STEPS}
    return {**settings, "augmentation.inverse_dynamics_prob": 1.0, **steps}
