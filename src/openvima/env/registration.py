"""Gymnasium ids of the environments, one per task: `openvima/rotate-v1` and so on."""

import importlib.util
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from openvima.env.tabletop import TabletopEnv

ENVIRONMENT_VERSION = 1  # bumped when the bytes for a seed change; see the history of `TabletopEnv`


def environment_id(task: str) -> str:
    """Return the Gymnasium id of a task, such as "openvima/rotate-v1"."""
    return f"openvima/{task}-v{ENVIRONMENT_VERSION}"


def make(task: str, **options: object) -> "TabletopEnv":
    """Build the environment of one task, without Gymnasium's wrappers.

    Args:
        task: Name of the task, such as "rotate", or its Gymnasium id, such as "openvima/rotate-v1".
        **options: Keyword arguments of `TabletopEnv`, such as `level="L1"`.

    Returns:
        The environment; `reset` it first.

    Raises:
        UnknownTaskError: There is no such task.
        ConfigError: The task is not defined at the level.
        ConfigError: An option is unknown or its value invalid.

    Example:
        >>> env = make("rotate", level="L1")
        >>> observation, info = env.reset(seed=7)
    """
    from openvima.env.tabletop import TabletopEnv

    name = task.removeprefix("openvima/").removesuffix(f"-v{ENVIRONMENT_VERSION}")
    return TabletopEnv(name, **options)  # type: ignore[arg-type]  # checked by the constructor


def register_environments() -> None:
    """Register all tasks with Gymnasium, those too that are registered later; idempotent."""
    from openvima.tasks import list_tasks
    from openvima.tasks.registry import watch_tasks

    watch_tasks(_register_environment)
    for task in list_tasks():
        _register_environment(task)


def _register_environment(task: str) -> None:
    from gymnasium.envs.registration import register, registry

    if environment_id(task) not in registry:
        register(
            id=environment_id(task), entry_point="openvima.env.tabletop:TabletopEnv", kwargs={"task": task}
        )


def register_with_gymnasium() -> None:
    """Register now if Gymnasium has been imported, else when it is.

    Importing Gymnasium takes longer than the rest of `import openvima`, and it no longer discovers plugins.
    """
    if "gymnasium.envs" in sys.modules:
        register_environments()
    elif not any(isinstance(finder, _AfterGymnasium) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterGymnasium())


class _AfterGymnasium(MetaPathFinder):
    """Registers the environments after the first import of `gymnasium.envs`, then removes itself."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium.envs":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is None or spec.loader is None:
            return None
        load = spec.loader.exec_module

        def load_and_register(module: ModuleType) -> None:
            load(module)
            register_environments()

        spec.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return spec
