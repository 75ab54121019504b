"""Sentences and numbers of the report: what levels and policies are, how rates are written."""

import html

from openvima.evaluation.results import Results

LEVEL_NAMES = {
    "train": "As in training",
    "L1": "Placement generalisation",
    "L2": "Combinatorial generalisation",
    "L3": "Novel objects",
    "L4": "Novel tasks",
}
LEVEL_MEANINGS = {
    "train": "Objects, textures and tasks of the training set, on fresh seeds.",
    "L1": "Everything was seen in training, but never laid out like this.",
    "L2": "Known objects and known textures, in pairs that training kept apart.",
    "L3": "Shapes that never occurred in training, and textures from the whole catalogue.",
    "L4": "Prompts of a kind that training did not contain, with new objects and textures.",
}
_ROLES = {
    "oracle": "Scripted solver that sees the true scene. The most that a policy can reach.",
    "random": "Actions drawn at random. The least that a policy must beat.",
    "untrained": "The same network before any training.",
    "run": "Trained policy: sees only the prompt and two camera images.",
}


_OWN_COLOURS = ("--series-oracle", "--series-random", "--series-untrained")
_NUM_COLOURS = 6  # in the style sheet, for all other policies


def role(results: Results, policy: str) -> str:
    """One or two sentences on what a policy is."""
    return _ROLES.get(results.policies.get(policy, {}).get("kind", "run"), _ROLES["run"])


def series_colours(results: Results) -> dict[str, str]:
    """CSS variable of the colour that stands for each policy."""
    colours: dict[str, str] = {}
    num_others = 0
    for policy in results.policy_names():
        own = f"--series-{results.policies.get(policy, {}).get('kind', 'run')}"
        if own in _OWN_COLOURS and own not in colours.values():
            colours[policy] = own
        else:
            colours[policy] = f"--series-{num_others % _NUM_COLOURS + 1}"
            num_others += 1
    return colours


def per_cent(fraction: float, decimals: int = 0) -> str:
    """Write a rate in per cent.

    Example:
        >>> per_cent(0.8666), per_cent(0.8666, 1)
        ('87 %', '86.7 %')
    """
    return f"{100 * fraction:.{decimals}f} %"


def span(interval: tuple[float, float]) -> str:
    """Write an interval in whole per cent, without the sign."""
    return f"{round(100 * interval[0])}–{round(100 * interval[1])}"


def counted(number: int, noun: str) -> str:
    """Write a number with its noun.

    Example:
        >>> counted(1, "step"), counted(3, "step")
        ('1 step', '3 steps')
    """
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def listed(names: list[str]) -> str:
    """Join names as in a sentence."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def headline(results: Results) -> str:
    """The finding in one line: what the trained policy, or else the first one, reaches on its first level."""
    means = results.level_means()
    trained = [mean for mean in means if results.policies.get(mean.policy, {}).get("kind") == "run"]
    first = (trained or means)[0]
    tasks = counted(len(first.tasks), "task")
    return f"{first.policy} solves {per_cent(first.mean)} of {first.level} episodes ({tasks})"


def findings(results: Results) -> str:
    """All level means as one sentence a policy."""
    sentences = []
    for policy in results.policy_names():
        rates = [f"{per_cent(m.mean)} on {m.level}" for m in results.level_means() if m.policy == policy]
        sentences.append(f"{policy}: {', '.join(rates)}")
    return "; ".join(sentences) + "."


def prose(text: str) -> str:
    """Escape text for HTML, and keep numbers with their per cent sign."""
    return html.escape(text, quote=True).replace(" %", "&nbsp;%")
