"""Reasons of failures in plain English."""

import re

from openvima.errors import cut
from openvima.evaluation.results import BAD_ACTION

_MAX_CHARACTERS = 300  # results come from anywhere
_NAMED = re.compile(r"(distractor )?object \d+ \(([^()]*)\)")
_UNNAMED = re.compile(r"(distractor )?\bobject\b(?: \d+)?")
_PLAIN = (  # what fits no pattern stays
    (r"(.*) is within [\d.]+ m of the target of (.*)", r"\1 was left where \2 belongs"),
    (r"(.*) is where it belongs later", r"\1 was moved to a later place too early"),
    (r"(.*) is where (.*) is", r"\1 was put where \2 lies"),
    (r"(.*) came before (.*)", r"\1 was moved before \2"),
    (r"the step did not bring (.*) to where it had to go next", r"\1 was not moved to its next place"),
    (r"(\d+) goals? (?:is|are) met instead of (\d+)", r"too much was moved: \1 goals met instead of \2"),
    (r"not done within the step limit: (\d+) of (\d+) goals were met", r"out of steps, \1 of \2 goals met"),
    (r"not done within the step limit", "out of steps"),
    (r"nothing was picked up within the step limit", "out of steps, nothing was picked up"),
    (
        r"only wrong objects were picked up within the step limit",
        "out of steps, only wrong objects picked up",
    ),
    (BAD_ACTION, "the policy returned an invalid action"),
)


def plain_reason(reason: str) -> str:
    """Write the reason of a failure, or a kind of reasons, in plain English.

    Example:
        >>> plain_reason("distractor object 7 (red ring) is where object 6 (tan star) is")
        'the red ring, a distractor, was put where the tan star lies'
        >>> plain_reason("object left the workspace")
        'an object left the workspace'
    """
    text = cut(reason, _MAX_CHARACTERS)
    text = _NAMED.sub(lambda found: f"the {found[2]}" + (", a distractor," if found[1] else ""), text)
    text = _UNNAMED.sub(lambda found: "a distractor" if found[1] else "an object", text)
    for pattern, plain in _PLAIN:
        if found := re.fullmatch(pattern, text):
            return found.expand(plain)
    return text
