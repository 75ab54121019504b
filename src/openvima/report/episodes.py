"""The list of all episodes, and the episodes that only one of two policies solved."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from openvima.evaluation.comparison import Comparison
from openvima.evaluation.results import EpisodeOutcome, Results
from openvima.report.reasons import plain_reason
from openvima.video.clips import Clip

MOST_EPISODES = 4000  # that are listed; of more, failures alone


class ListedEpisode(NamedTuple):
    """One episode, how it ended, and the id of its video on the page; that is empty without one."""

    policy: str
    level: str
    task: str
    outcome: EpisodeOutcome
    video: str

    @property
    def reason(self) -> str:
        """Why it failed, in plain English; empty on success."""
        return plain_reason(self.outcome.reason)

    @property
    def cause(self) -> str:
        """The same without the names of objects, for a menu."""
        return plain_reason(self.outcome.kind)


class Disagreement(NamedTuple):
    """Seeds of a task and level that only one of two policies solved."""

    task: str
    level: str
    only_a: tuple[int, ...]
    only_b: tuple[int, ...]


def video_ids(clips: Sequence[Clip]) -> dict[tuple[str, str, str, int], str]:
    """Name each video of the page, by policy, task, level and seed."""
    return {(c.policy, c.task, c.level, c.seed): f"video-{number}" for number, c in enumerate(clips, 1)}


def listed_episodes(
    results: Results, videos: Mapping[tuple[str, str, str, int], str]
) -> tuple[list[ListedEpisode], int]:
    """List the episodes without input ablations, failures first.

    Args:
        results: The evaluation.
        videos: Ids of the videos on the page.

    Returns:
        At most `MOST_EPISODES` episodes, and how many there are.
    """
    episodes = [
        ListedEpisode(r.policy, r.level, r.task, o, videos.get((r.policy, r.task, r.level, o.seed), ""))
        for r in results.rows
        if not r.ablation
        for o in r.outcomes
    ]
    ranked = sorted(episodes, key=lambda episode: episode.outcome.success)
    if len(ranked) > MOST_EPISODES:
        ranked = [episode for episode in ranked if not episode.outcome.success][:MOST_EPISODES]
    return ranked, len(episodes)


def disagreements(results: Results, comparison: Comparison) -> list[Disagreement]:
    """List the episodes that only one of two policies solved; none for scores under an input ablation."""
    found = []
    for difference in comparison.tasks:
        rows = [results.row(name, difference.task, difference.level) for name in (comparison.a, comparison.b)]
        solved = [{o.seed: o.success for o in row.outcomes} for row in rows if row is not None]
        if len(solved) == 2 and (difference.only_a or difference.only_b):
            a, b = solved
            only_a = tuple(seed for seed in a if a[seed] and b.get(seed) is False)
            only_b = tuple(seed for seed in b if b[seed] and a.get(seed) is False)
            found.append(Disagreement(difference.task, difference.level, only_a, only_b))
    return found
