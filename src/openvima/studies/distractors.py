"""How does success fall with the number of distractors on the table?"""

from openvima.studies.study import L4_TASKS, TRAINING_TASKS, Study, StudyInputs

COUNTS = (0, 1, 2, 4, 6)
WITHOUT_OPTION = "pick_in_order_then_restore"


def distractors(inputs: StudyInputs) -> Study:
    """Existing policies on all tasks that take distractors."""
    tasks = tuple(task for task in (*TRAINING_TASKS, *L4_TASKS) if task != WITHOUT_OPTION)
    return Study(
        name="distractors",
        question="How does success fall with the number of distractors?",
        quantity="distractors on the table",
        runs=inputs.policy_runs(),
        evaluation=inputs.evaluation(
            tasks, plain=False, ablations=tuple(f"num_distractors:{count}" for count in COUNTS)
        ),
        x_axis="rate",
        notes=(
            "Episodes with other numbers of distractors are other scenes; they are not paired.",
            f"All tasks but {WITHOUT_OPTION}, which has no distractors.",
        ),
    )
