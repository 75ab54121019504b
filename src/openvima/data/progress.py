"""How far generating is: what `generate` tells its caller now and then."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from openvima.data.planning import Block
from openvima.errors import brief_repr
from openvima.multiprocess import Counts

NUM_COUNTS = 3  # that a block tells: episodes written, seeds tried, redraws


@dataclass(frozen=True, slots=True)
class TaskProgress:
    """How far one task is.

    Args:
        task: Its name.
        done: Episodes written, those of whole shards that were there before included.
        total: Episodes asked for.
        written: Episodes written by this run.
        tried: Seeds that this run tried.
        redraws: Unlucky draws that the sampler threw away in this run.
    """

    task: str
    done: int
    total: int
    written: int = 0
    tried: int = 0
    redraws: int = 0


@dataclass(frozen=True, slots=True)
class GenerationProgress:
    """How far all tasks are.

    Args:
        tasks: One entry a task, by name.
    """

    tasks: tuple[TaskProgress, ...]

    __repr__ = brief_repr

    @property
    def done(self) -> int:
        """Episodes written, those of whole shards that were there before included."""
        return sum(task.done for task in self.tasks)

    @property
    def total(self) -> int:
        """Episodes asked for."""
        return sum(task.total for task in self.tasks)

    @property
    def written(self) -> int:
        """Episodes written by this run."""
        return sum(task.written for task in self.tasks)

    @property
    def tried(self) -> int:
        """Seeds that this run tried."""
        return sum(task.tried for task in self.tasks)


Report = Callable[[GenerationProgress], None]


def reporter(
    report: Report | None, blocks: Sequence[Block], missing: Sequence[Block]
) -> Callable[[Counts], None]:
    """Make of a caller's `report` what an engine calls; it first receives what was there before.

    Args:
        report: The caller's, if it wants to know.
        blocks: All blocks of this run.
        missing: Those that are still to be written, in the order in which an engine gets them.
    """
    if report is None:
        return lambda counts: None
    totals, left = Counter[str](), Counter[str]()
    for block in blocks:
        totals[block.info.task] += block.episodes
    for block in missing:
        left[block.info.task] += block.episodes

    def tell(counts: Counts) -> None:
        sums = {task: [0] * NUM_COUNTS for task in totals}
        for block, row in zip(missing, counts, strict=True):
            of_task = sums[block.info.task]
            for index, number in enumerate(row):
                of_task[index] += number
        report(
            GenerationProgress(
                tuple(
                    TaskProgress(task, totals[task] - left[task] + sums[task][0], totals[task], *sums[task])
                    for task in sorted(totals)
                )
            )
        )

    tell([(0,) * NUM_COUNTS] * len(missing))
    return tell
