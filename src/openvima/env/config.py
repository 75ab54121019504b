"""Settings that all environments of a run share: assets, difficulty, fidelity, prompts."""

from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any  # options are of whatever type a task declares

from openvima.tasks.options import check_difficulty
from openvima.tasks.prompts import MULTIMODAL, check_prompts
from openvima.user_code import is_code, without_folder

if TYPE_CHECKING:
    from openvima.env.tabletop import TabletopEnv


@dataclass(frozen=True, slots=True)
class EnvConfig:
    """Settings of the environments, whatever the task.

    Args:
        assets: Asset pack: "procedural", "original", MODULE:FUNCTION, FILE.py:FUNCTION, or the folder of a
            checkout of VIMA-Bench.
        compat: Reproduce VIMA-Bench's quirks.
        difficulty: "easy", as for all published results, "medium" or "hard".
        prompts: "multimodal", as for all published results, "text" or "mixed"; see `openvima.make`.

    Raises:
        ConfigError: There is no such difficulty or form of prompts.
    """

    assets: str = "procedural"
    compat: bool = False
    difficulty: str = "easy"
    prompts: str = MULTIMODAL

    def __post_init__(self) -> None:
        check_difficulty(self.difficulty)
        check_prompts(self.prompts)

    def make(self, task: str, level: str, *, domain: str, realtime: bool = False) -> "TabletopEnv":
        """Build an environment.

        Args:
            task: Name of the task.
            level: "train" or "L1" to "L4".
            domain: Domain of the seeds.
            realtime: Record `frames` during each step.

        Raises:
            ConfigError: The task does not have this difficulty, or has no text form.
        """
        from openvima.env.tabletop import TabletopEnv

        return TabletopEnv(
            task,
            level=level,
            domain=domain,
            assets=self.assets,
            compat=self.compat,
            prompts=self.prompts,
            realtime=realtime,
            **self.options(),
        )

    def options(self) -> dict[str, Any]:
        """Return the options of the task."""
        if self.difficulty == "easy":  # a task with one difficulty has no such option
            return {}
        return {"difficulty": self.difficulty}

    def record(self) -> dict[str, str | bool]:
        """Return the settings for a record, without paths and without the prompts if they are published."""
        is_named = self.assets == "procedural" or is_code(self.assets)
        record = {**asdict(self), "assets": without_folder(self.assets) if is_named else "original"}
        if self.prompts == MULTIMODAL:
            del record["prompts"]
        return record


ENV_SETTINGS = tuple(field.name for field in fields(EnvConfig))
"""Names of the settings, as data sets and results record them."""

DEFAULT_ENV_CONFIG = EnvConfig()
