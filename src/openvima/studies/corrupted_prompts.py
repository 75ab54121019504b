"""How does success fall when words of the prompt are masked, swapped or replaced?"""

from openvima.studies.study import L4_TASKS, TRAINING_TASKS, Study, StudyInputs

ABLATIONS = (
    "masked_words:0.1",
    "masked_words:0.2",
    "masked_words:0.4",
    "swapped_words:0.1",
    "swapped_words:0.2",
    "swapped_words:0.4",
    "gibberish_words",
    "scrambled_words",
    "other_prompt_images",
    "no_prompt",
)


def corrupted_prompts(inputs: StudyInputs) -> Study:
    """Existing policies on all tasks, with each corruption of the prompt on the same episodes."""
    return Study(
        name="corrupted-prompts",
        question="How does success fall when the prompt is corrupted?",
        quantity="corruption of the prompt",
        runs=inputs.policy_runs(),
        # At nano two levels: all training tasks, and the new ones.
        evaluation=inputs.evaluation(
            (*TRAINING_TASKS, *L4_TASKS), ("L1", "L4") if inputs.scale.is_nano else (), ablations=ABLATIONS
        ),
        x_axis="ablation",
    )
