"""Can a policy solve a task that it was not trained on, from an example in the prompt?"""

from openvima.evaluation.prompt_ablations import IN_CONTEXT_TASKS
from openvima.studies.study import NANO_POINTER, Run, Settings, Study, StudyInputs

# Of several steps too, whose motions are worth following.
NANO_TASKS = (
    "visual_manipulation",
    "rotate",
    "novel_noun",
    "same_shape",
    "manipulate_old_neighbor",
    "pick_in_order_then_restore",
)
PRETRAINING_STEPS = 10_300  # the longest of the paper
TEXT_DESCRIPTION_PROB = 0.5


def in_context(inputs: StudyInputs) -> Study:
    """Modified and plain fine-tuning after inverse-dynamics pretraining, and none; three tasks held out."""
    nano = inputs.scale.is_nano
    settings: Settings = {
        **(NANO_POINTER if nano else inputs.network("midas")),
        "loader.exclude_tasks": ",".join(IN_CONTEXT_TASKS),
    }
    steps = inputs.scale.settings["schedule.steps"] if nano else PRETRAINING_STEPS
    pretraining = {"augmentation.inverse_dynamics_prob": 1.0, "schedule.steps": steps}
    modified = {"augmentation.text_description_prob": TEXT_DESCRIPTION_PROB}
    return Study(
        name="in-context",
        question="Can a policy follow an example in the prompt of a task it was not trained on?",
        quantity="training",
        data=inputs.demonstrations(NANO_TASKS if nano else ()),
        settings=settings,
        runs=(
            Run("pretraining, modified fine-tuning", init=pretraining, settings=modified),
            Run("pretraining, plain fine-tuning", init=pretraining),
            Run("no pretraining", settings={"schedule.steps": 2 * steps} if nano else {}),
        ),
        evaluation=inputs.evaluation(IN_CONTEXT_TASKS, ("L1", "L4"), ablations=("in_context",)),
        notes=(
            "Published for 92M, in % as a mean of the three tasks: 36.2 with pretraining and modified "
            "fine-tuning, 23.3 with plain fine-tuning, 0.7 without pretraining.",
            *(("The network here is the pointer model nano, not MIDAS.",) if nano else ()),
            "Modified fine-tuning describes object images of prompts by text, at random.",
        ),
    )
