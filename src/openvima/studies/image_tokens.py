"""Which tokens should stand for images: objects, or the whole frame?"""

from openvima.studies.study import Run, Study, StudyInputs

TOKENS = ("objects", "object-perceiver", "image-perceiver", "patches", "image")


def image_tokens(inputs: StudyInputs) -> Study:
    """VIMA with each kind of image tokens."""
    return Study(
        name="image-tokens",
        question="Which image tokens are best: objects, or parts of the whole frame?",
        quantity="image tokens",
        data=inputs.demonstrations(),
        settings=inputs.network("vima"),
        runs=tuple(Run(tokens, settings={"model.image_tokens": tokens}) for tokens in TOKENS),
        evaluation=inputs.evaluation(),
        notes=("The paper shows its own comparison as a figure without numbers by level; none are beside.",),
    )
