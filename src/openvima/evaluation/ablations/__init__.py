"""Input ablations: each removes, replaces or corrupts one input of a policy, or makes the episodes harder.

An ablation is named NAME or NAME:RATE. Names joined by "+", such as `masked_words:0.2+noisy_boxes:3`, are one
ablation of all of them. `registry.py` lists them; the other files hold what they do, one file a kind:
`words.py` (words of the prompt), `images.py` (images of the prompt), `objects.py` (object ids and boxes) and
`environments.py` (settings of the environment, of which other episodes may follow).

Random choices follow from the episode's task, level and seed and the ablation's name, not from the batch or
the number of workers. They are the same at every rate: what a low rate masks or swaps, a high one does too.
"""

from openvima.evaluation.ablations.inputs import AblatedInput
from openvima.evaluation.ablations.registry import (
    ABLATIONS,
    DETECTED_BOXES,
    EXAMPLE_PROMPTS,
    IN_CONTEXT,
    INPUT_ABLATIONS,
    MORE_ABLATIONS,
    NOISY_BOXES,
    ORACLE_DEMONSTRATION,
    InputAblation,
    RatedAblation,
    ablate,
    ablated_environment,
    ablation_parts,
    applies_to,
    canonical_ablation,
    scenes_of,
)

__all__ = [
    "ABLATIONS",
    "DETECTED_BOXES",
    "EXAMPLE_PROMPTS",
    "INPUT_ABLATIONS",
    "IN_CONTEXT",
    "MORE_ABLATIONS",
    "NOISY_BOXES",
    "ORACLE_DEMONSTRATION",
    "AblatedInput",
    "InputAblation",
    "RatedAblation",
    "ablate",
    "ablated_environment",
    "ablation_parts",
    "applies_to",
    "canonical_ablation",
    "scenes_of",
]
