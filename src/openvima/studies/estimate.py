"""Estimated time of a study on this machine, from a short calibration in a temporary folder.

Measured are a few demonstrations, training steps of each kind of network, and episodes of each policy; times
are scaled to the sizes of the study. Without a GPU they are CPU times, as of an otherwise idle machine. Start
of processes and object caches are not part of it.
"""

import json
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from openvima.data import Dataset, GenerateConfig, generate
from openvima.evaluation.config import plan as plan_evaluation
from openvima.evaluation.runner import evaluate
from openvima.studies.plan import Evaluation, Plan, Training
from openvima.studies.study import Demonstrations, EvaluationSettings
from openvima.training.config import TrainingConfig

_DEMONSTRATIONS, _STEPS, _EPISODES = 4, 6, 2
_SCENES = 64  # at least as many objects as a batch of pretraining needs
_Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated time of some stages.

    Args:
        what: The stages.
        count: Their number.
        seconds: Of all together, in one process.
    """

    what: str
    count: int
    seconds: float


def estimate(plan: Plan, say: _Say = lambda _: None) -> list[Estimate]:
    """Measure and estimate the stages of a plan.

    Args:
        plan: The plan.
        say: Called with what is being measured.

    Returns:
        Demonstrations, trainings by run, evaluations by run.
    """
    with tempfile.TemporaryDirectory() as folder:
        return list(_Calibration(plan, Path(folder), say).estimates())


def _clock() -> float:
    """CPU time of this process, as of an idle machine; with a GPU, the time of day."""
    import torch

    return time.monotonic() if torch.cuda.is_available() else time.process_time()


def _source(config: TrainingConfig) -> str:
    """Name of the data set that the demonstrations of a training are all or a fraction of."""
    return config.data.name.partition("-")[0]


class _Calibration:
    def __init__(self, plan: Plan, folder: Path, say: _Say) -> None:
        self.plan, self.folder, self.say = plan, folder, say
        self.num_folders = 0
        self.speeds: dict[str, tuple[Path, float, float, float]] = {}

    def estimates(self) -> Iterable[Estimate]:
        for demonstrations, out in self.plan.data.items():
            self.say(f"generating {_DEMONSTRATIONS} demonstrations of each task")
            total = len(demonstrations.tasks) * demonstrations.episodes
            name = f"{total:,} demonstrations of {len(demonstrations.tasks)} tasks (data/{out.name})"
            yield Estimate(name, 1, total * self._generating(demonstrations))
        trainings: dict[str, list[Training]] = {}
        for training in (*self.plan.initial, *self.plan.trainings):
            trainings.setdefault(training.run, []).append(training)
        runs: dict[str, Path] = {}
        for run, of_run in trainings.items():
            seconds = 0.0
            for training in of_run:
                runs[run], its_seconds = self._training(training.config)
                seconds += its_seconds
            yield Estimate(f"training {run or 'initial weights'}", len(of_run), seconds)
        speeds: dict[tuple[Path | None, EvaluationSettings | None], float] = {}
        evaluations: dict[str, list[Evaluation]] = {}
        for evaluation in self.plan.evaluations:
            evaluations.setdefault(evaluation.run.label, []).append(evaluation)
        for run, of_run in evaluations.items():
            episodes = sum(batch.episodes for batch in plan_evaluation(of_run[0].config))
            measured, settings = runs.get(run), of_run[0].run.evaluation
            if measured is None or (measured, settings) not in speeds:  # equal networks are equally fast
                self.say(f"evaluating {run} in {_EPISODES} episodes of each task")
                speeds[measured, settings] = self._evaluating(of_run[0], measured)
            seconds = episodes * len(of_run) * speeds[measured, settings]
            yield Estimate(f"evaluating {run}, {episodes:,} episodes each", len(of_run), seconds)

    def _new(self) -> Path:
        self.num_folders += 1
        return self.folder / str(self.num_folders)

    def _generating(self, demonstrations: Demonstrations) -> float:
        """Return seconds a demonstration; the first ones compile and do not count."""
        out = self.folder / f"data-{next(i for i, d in enumerate(self.plan.data) if d == demonstrations)}"
        config = GenerateConfig(
            out=out, tasks=demonstrations.tasks, episodes=1, env_config=demonstrations.env_config
        )
        generate(config)
        start = _clock()
        generate(replace(config, episodes=1 + _DEMONSTRATIONS))
        return (_clock() - start) / (_DEMONSTRATIONS * len(demonstrations.tasks))

    def _training(self, config: TrainingConfig) -> tuple[Path, float]:
        """Return a run folder of a short training, and the seconds of the whole one."""
        from openvima.training.building import resolve

        config = resolve(config)
        steps = config.pretraining.steps or 0
        settings = {**config.identity(), "seed": 0, "init_from": None, "pretraining": steps > 0}
        key = json.dumps({**settings, "schedule": None}, sort_keys=True)
        if key not in self.speeds:
            self.say(f"training {config.preset} for {_STEPS} steps")
            self.speeds[key] = self._measured(config)
        run, step, pretraining_step, scene = self.speeds[key]
        step *= self._batch_size(config) / self._num_measured(config)
        num_scenes = config.pretraining.num_scenes if steps else 0
        count = config.schedule.steps  # studies set steps, not epochs
        return run, count * step + steps * pretraining_step + num_scenes * scene

    def _measured(self, config: TrainingConfig) -> tuple[Path, float, float, float]:
        """Return the run folder, and seconds a step, a step of pretraining, and a rendered scene."""
        from openvima.training import train

        data = self._data_of(config)
        pretraining = replace(
            config.pretraining, steps=_STEPS if config.pretraining.steps else 0, num_scenes=_SCENES
        )
        short = replace(
            config,
            data=data,
            out=self._new(),
            init_from=None,
            pretraining=pretraining,
            schedule=replace(config.schedule, steps=_STEPS, epochs=None, checkpoint_every=_STEPS // 2),
            loader=replace(config.loader, validation_fraction=0.0),
        )
        marks: dict[str, list[float]] = {}

        def report(done: int, total: int, note: str) -> None:
            marks.setdefault(note.partition(":")[0].partition(",")[0], []).append(_clock())

        train(short, report)
        times = {name: found[-1] - found[0] for name, found in marks.items()}
        steps = _STEPS - _STEPS // 2
        return (
            short.out,
            times["2-cloning"] / steps,
            times.get("1-pretraining", 0.0) / steps,
            times.get("rendering scenes", 0.0) / _SCENES,
        )

    def _batch_size(self, config: TrainingConfig) -> int:
        """Return the demonstrations of a batch, at most as many as there are."""
        subsets = {subset.out: subset.fraction for subset in self.plan.subsets}
        demonstrations = next(d for d, out in self.plan.data.items() if out.name == _source(config))
        of_each = max(1, round(subsets.get(config.data, 1.0) * demonstrations.episodes))
        return min(config.loader.batch_size, of_each * len(demonstrations.tasks))

    def _num_measured(self, config: TrainingConfig) -> int:
        """Return the demonstrations of a measured batch."""
        return min(config.loader.batch_size, len(Dataset(self._data_of(config))))

    def _data_of(self, config: TrainingConfig) -> Path:
        """Return the calibration's demonstrations for those of a training."""
        index = next(i for i, out in enumerate(self.plan.data.values()) if out.name == _source(config))
        return self.folder / f"data-{index}"

    def _evaluating(self, evaluation: Evaluation, run: Path | None) -> float:
        """Return seconds an episode; a first evaluation loads and compiles, and does not count."""
        config = evaluation.config
        if run is not None:
            config = replace(config, policies=(f"{config.policies[0].partition('=')[0]}={run}",))
        evaluate(replace(config, out=self._new(), episodes=1))
        config = replace(config, out=self._new(), episodes=_EPISODES)
        start = _clock()
        evaluate(config)
        return (_clock() - start) / sum(batch.episodes for batch in plan_evaluation(config))
