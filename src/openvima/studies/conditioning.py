"""How should the decoder read the prompt: by cross-attention, or as a prefix of its own sequence?"""

from openvima.studies.study import NANO_POINTER, Run, Study, StudyInputs

CONDITIONINGS = ("cross-attention", "prefix")


def conditioning(inputs: StudyInputs) -> Study:
    """Cross-attention to the prompt, and the prompt as a prefix (the paper's gpt-decoder)."""
    # VIMA's own head at nano solves nothing yet after as many steps; the pointer model does.
    network = NANO_POINTER if inputs.scale.is_nano else inputs.network("vima")
    return Study(
        name="conditioning",
        question="Should the decoder attend to the prompt, or read it as a prefix?",
        quantity="prompt conditioning",
        data=inputs.demonstrations(),
        settings=network,
        runs=tuple(Run(name, settings={"model.conditioning": name}) for name in CONDITIONINGS),
        evaluation=inputs.evaluation(),
        notes=("A prefix decoder has twice as many layers of half the size: parameters are about equal.",),
    )
