"""How much success is lost from known objects in new places (L1) to new tasks (L4), by model?"""

from openvima.policies.presets import PUBLISHED
from openvima.report.published import leading_models
from openvima.studies.study import NANO_POINTER, PublishedPoint, Run, Study, StudyInputs


def level_drop(inputs: StudyInputs) -> Study:
    """All architectures of the papers at one size; at nano the pointer model as well."""
    own = (Run("nano", settings=NANO_POINTER),) if inputs.scale.is_nano else ()
    return Study(
        name="level-drop",
        question="How much success is lost from L1 to L4?",
        quantity="level",
        data=inputs.demonstrations(),
        runs=(*own, *(Run(name, settings=inputs.network(name)) for name in PUBLISHED)),
        evaluation=inputs.evaluation(),
        x_axis="level",
        published=tuple(
            PublishedPoint(f"{model.model} {model.size}", level, level, rate / 100, model.mark(level))
            for model in leading_models()
            for level, rate in model.levels.items()
        ),
        notes=("Tasks at L4 are others than at L1 to L3.",),
    )
