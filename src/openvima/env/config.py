"""Settings that all environments of a run share: assets, fidelity, prompts, task options."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any  # options are of whatever type a task declares

from openvima.scene.action import PRIMITIVES, check_control
from openvima.tasks import sample_episode, task_spec
from openvima.tasks.options import options_of, options_text, parse_options
from openvima.tasks.prompts import MULTIMODAL, check_prompts
from openvima.user_code import is_code, without_folder

if TYPE_CHECKING:
    from openvima.env.tabletop import TabletopEnv
    from openvima.scene import Episode


@dataclass(frozen=True, slots=True)
class EnvConfig:
    """Settings of the environments, whatever the task.

    Args:
        assets: Asset pack: "procedural", "original", MODULE:FUNCTION, FILE.py:FUNCTION, or the folder of a
            checkout of VIMA-Bench.
        compat: Reproduce VIMA-Bench's quirks.
        prompts: "multimodal", as for all published results, "text" or "mixed"; see `openvima.make`.
        task_options: [TASK.]NAME=VALUE,…, such as "num_distractors=3,rotate.difficulty=hard"; kept sorted.
            Without a task, an option holds for all tasks that have it.
        control: "primitives", as for all published results, or "end_effector"; see `openvima.make`.

    Raises:
        ConfigError: There is no such form of prompts, no such control, or the task options have another form.
    """

    assets: str = "procedural"
    compat: bool = False
    prompts: str = MULTIMODAL
    task_options: str = ""
    control: str = PRIMITIVES

    def __post_init__(self) -> None:
        check_prompts(self.prompts)
        check_control(self.control)
        object.__setattr__(self, "task_options", options_text(parse_options(self.task_options)))

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> "EnvConfig":
        """Read the settings out of a record of a data set or of results; those that it lacks are published.

        Raises:
            ConfigError: A setting is invalid, or the record is of an unsupported version.
        """
        return EnvConfig(**{name: record[name] for name in ENV_SETTINGS if name in record})

    def make(self, task: str, level: str, *, domain: str, realtime: bool = False) -> "TabletopEnv":
        """Build an environment.

        Args:
            task: Name of the task.
            level: one of `openvima.catalog.LEVELS`.
            domain: Domain of the seeds.
            realtime: Record `frames` during each step.

        Raises:
            ConfigError: The task has no text form, or an option is invalid.
        """
        from openvima.env.tabletop import TabletopEnv

        return TabletopEnv(
            task,
            level=level,
            domain=domain,
            realtime=realtime,
            control=self.control,
            **self._sampling(task),
        )

    def sample(self, task: str, level: str, seed: int, *, domain: str) -> "Episode":
        """Sample an episode; see `openvima.tasks.sample_episode`."""
        return sample_episode(task, level=level, seed=seed, domain=domain, **self._sampling(task))

    def _sampling(self, task: str) -> dict[str, Any]:
        shared = {"assets": self.assets, "compat": self.compat, "prompts": self.prompts}
        return {**shared, **self.options(task)}

    def options(self, task: str) -> dict[str, Any]:
        """Return the options of a task.

        Raises:
            UnknownTaskError: There is no such task.
            ConfigError: The task does not have one of its options, or a value is not of its type.
        """
        return options_of(task_spec(task), self.task_options)

    def record(self) -> dict[str, str | bool]:
        """Return the settings for a record, without paths, and those from `prompts` on unless published."""
        is_named = self.assets == "procedural" or is_code(self.assets)
        record = {**asdict(self), "assets": without_folder(self.assets) if is_named else "original"}
        return without_published(record)


def without_published(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without prompts, task options and control that are as published."""
    published = {"prompts": MULTIMODAL, "task_options": "", "control": PRIMITIVES}
    return {name: value for name, value in record.items() if value != published.get(name, ...)}


ENV_SETTINGS = tuple(field.name for field in fields(EnvConfig))
"""Names of the settings, as data sets and results record them."""

DEFAULT_ENV_CONFIG = EnvConfig()
