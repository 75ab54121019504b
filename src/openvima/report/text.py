"""Sentences and numbers of the report: what policies are, how rates are written."""

from collections.abc import Iterable, Mapping
from itertools import cycle
from typing import Any

from openvima.evaluation.ablations import INPUT_ABLATIONS, names_in
from openvima.evaluation.comparison import Comparison, Difference
from openvima.evaluation.results import Results, Row
from openvima.evaluation.sources import TRAINED_KINDS

_ROLES = {
    "oracle": "Scripted solver with access to the scene: the upper bound.",
    "random": "Random actions: the lower bound.",
    "untrained": "A network with random weights.",
    "run": "Trained policy: observes the prompt and two camera images.",
    "code": "Policy of the user's own code: observes the prompt and two camera images.",
    "vlm": "Vision-language model, asked over the chat protocol: sees the prompt and the table.",
    "remote": "Policy behind a server: observes the prompt and two camera images.",
}
_OWN_COLOURS = ("--series-oracle", "--series-random", "--series-untrained")
_NUM_COLOURS = 6  # in the style sheet, for all other policies


def ablation_name(ablation: str) -> str:
    """Name of an ablation as words.

    Example:
        >>> ablation_name("masked_words:0.2+noisy_boxes:3")
        'masked words 0.2 + noisy boxes 3'
    """
    words = ablation.replace("num_", "number_of_").replace("_", " ")
    return words.replace(":", " ").replace("+", " + ")


def ablation_descriptions(ablations: Iterable[str]) -> dict[str, str]:
    """One sentence on each input ablation by its name as words, without rates and each of several apart."""
    names = dict.fromkeys(name for ablation in ablations for name in names_in(ablation))
    return {
        ablation_name(name): INPUT_ABLATIONS[name].description
        if name in INPUT_ABLATIONS
        else "See the documentation of the evaluation."
        for name in names
    }


def role(results: Results, policy: str) -> str:
    """Sentences on what a policy is, whether it got the segmentation, and what its training saw."""
    record = results.policies.get(policy, {})
    excluded, seen = record.get("excluded_tasks"), record.get("held_out_data")
    left_out = f" Trained without {', '.join(map(str, excluded))}." if isinstance(excluded, list) else ""
    saw = f" Trained on held-out {', '.join(map(str, seen))}." if isinstance(seen, list) else ""
    return _ROLES.get(record.get("kind", "run"), _ROLES["run"]) + _segmentation(record) + left_out + saw


def _segmentation(record: Mapping[str, Any]) -> str:
    """Say whether a policy of others was sent the segmentation, if the results do."""
    metadata = record.get("metadata")
    asked = (metadata if isinstance(metadata, dict) else record).get("modalities")
    if not isinstance(asked, list):
        return ""
    return " The segmentation was sent to it." if "segm" in asked else " It got no segmentation."


def series_colours(results: Results) -> dict[str, str]:
    """CSS variable of the colour that stands for each policy."""
    colours: dict[str, str] = {}
    others = cycle(f"--series-{number + 1}" for number in range(_NUM_COLOURS))
    for policy in results.policy_names():
        own = f"--series-{results.policies.get(policy, {}).get('kind', 'run')}"
        is_free = own in _OWN_COLOURS and own not in colours.values()
        colours[policy] = own if is_free else next(others)
    return colours


def percent(fraction: float, decimals: int = 0) -> str:
    """Format a rate as a percentage.

    Example:
        >>> percent(0.8666), percent(0.8666, 1)
        ('87 %', '86.7 %')
    """
    return f"{100 * fraction:.{decimals}f} %"


def points(difference: float) -> str:
    """Write a difference of rates in percentage points, with its sign.

    Example:
        >>> points(0.043), points(-0.5)
        ('+4.3', '−50.0')
    """
    return f"{100 * difference:+.1f}".replace("-", "−")


def points_span(interval: tuple[float, float]) -> str:
    """Write the interval of a difference.

    Example:
        >>> points_span((-0.02, 0.3))
        '−2.0 … +30.0'
    """
    return " … ".join(map(points, interval))


def probability(p_value: float) -> str:
    """Write a p-value with as many digits as matter.

    Example:
        >>> probability(0.0402), probability(0.3), probability(1e-7)
        ('0.040', '0.30', '< 0.001')
    """
    if p_value < 0.001:
        return "< 0.001"
    return f"{p_value:.3f}" if p_value < 0.1 else f"{p_value:.2f}"


def span(interval: tuple[float, float]) -> str:
    """Format an interval in whole percent, without the sign."""
    return f"{round(100 * interval[0])}–{round(100 * interval[1])}"


def counted(number: int, noun: str) -> str:
    """Write a number with its noun.

    Example:
        >>> counted(1, "step"), counted(3, "step")
        ('1 step', '3 steps')
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def headline(results: Results) -> str:
    """The finding in one line: what the trained policy, or else the first one, reaches on its first level."""
    played = results.level_means()
    means = [mean for mean in played if not mean.ablation] or played
    trained = [m for m in means if results.policies.get(m.policy, {}).get("kind") in TRAINED_KINDS]
    first = (trained or means)[0]
    tasks = counted(len(first.tasks), "task")
    return f"{first.policy} solves {percent(first.mean)} of {first.level} episodes ({tasks})"


def episodes_each(rows: Iterable[Row]) -> str:
    """Say how many episodes a row has: "200 episodes", or "20 to 200 episodes"."""
    episodes = sorted({row.episodes for row in rows})
    return f"{episodes[0]:,} to " * (len(episodes) > 1) + counted(episodes[-1], "episode")


def finding(comparison: Comparison, difference: Difference) -> str:
    """One of its differences in a sentence."""
    where = difference.level or "all levels together"
    a, b, value, (low, high) = comparison.a, comparison.b, difference.difference, difference.interval
    if value < 0 and difference.verdict != "noise":  # a reader expects the better one first
        a, b, value, low, high = b, a, -value, -high, -low
    size = f"{points(value)} points ({points_span((low, high))})"
    if difference.verdict == "noise":
        return f"On {where}, {a} − {b} is {size}: not significant."
    doubt = ", though not by the adjusted exact test" if difference.verdict == "unsure" else ""
    return f"On {where}, {a} is better than {b}: {size}{doubt}."
