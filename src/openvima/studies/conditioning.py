"""How should the decoder read the prompt: by cross-attention, or as a prefix of its own sequence?"""

from openvima.studies.study import Run, Study, StudyInputs

CONDITIONINGS = ("cross-attention", "prefix")
# Head, length and tasks at nano: what shows differences within minutes of training.
NANO_SETTINGS = {"preset": "nano-bins", "schedule.steps": 1500}
NANO_TASKS = ("visual_manipulation", "scene_understanding", "rotate", "novel_noun")


def conditioning(inputs: StudyInputs) -> Study:
    """VIMA with cross-attention to the prompt, and with the prompt as a prefix (the paper's gpt-decoder)."""
    nano = inputs.scale.is_nano
    tasks = NANO_TASKS if nano else inputs.scale.tasks
    return Study(
        name="conditioning",
        question="Should the decoder attend to the prompt, or read it as a prefix?",
        quantity="prompt conditioning",
        data=inputs.demonstrations(tasks),
        settings=NANO_SETTINGS if nano else inputs.network("vima"),
        runs=tuple(Run(name, settings={"model.conditioning": name}) for name in CONDITIONINGS),
        evaluation=inputs.evaluation((*tasks, *inputs.scale.new_tasks)),
        notes=("A prefix decoder has twice as many layers of half the size: parameters are about equal.",),
    )
