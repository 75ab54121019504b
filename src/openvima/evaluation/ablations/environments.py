"""Ablations that change the environment: another form of the prompt, other options of the tasks.

Only tasks that have the form or the option are evaluated. With other options a seed stands for another
scene, so these episodes are not paired with the plain ones.
"""

from dataclasses import replace

from openvima.env.config import EnvConfig
from openvima.errors import ConfigError
from openvima.tasks.options import TaskOptions
from openvima.tasks.sampling import check_task_options, takes_prompts

_NUM_DISTRACTORS = "num_distractors"


def with_text_prompts(env_config: EnvConfig, _: float) -> EnvConfig:
    """Describe all objects in prompts; synonyms stay if they are asked for."""
    _form, comma, synonyms = env_config.prompts.partition(",")
    return replace(env_config, prompts=f"text{comma}{synonyms}")


def with_paraphrased_prompts(env_config: EnvConfig, _: float) -> EnvConfig:
    """Describe objects by synonyms: all of them, or some where prompts are mixed."""
    form = "mixed" if env_config.prompts.startswith("mixed") else "text"
    return replace(env_config, prompts=f"{form},paraphrased")


def has_form(task: str, env_config: EnvConfig) -> bool:
    """Whether a task takes the prompts of an environment, with an object image to describe."""
    return takes_prompts(task, "text") and takes_prompts(task, env_config.prompts)


def with_num_distractors(env_config: EnvConfig, count: float) -> EnvConfig:
    """Put so many distractors on the table, in place of the number that the settings name."""
    others = [
        entry for entry in TaskOptions.parse(env_config.task_options).entries if entry[1] != _NUM_DISTRACTORS
    ]
    options = TaskOptions((*others, ("", _NUM_DISTRACTORS, str(int(count)))))
    return replace(env_config, task_options=str(options))


def allows_num_distractors(task: str, env_config: EnvConfig) -> bool:
    """Whether a task has the option and takes as many."""
    entries = TaskOptions.parse(env_config.task_options).entries
    (own,) = (entry for entry in entries if entry[1] == _NUM_DISTRACTORS)
    try:
        check_task_options((task,), str(TaskOptions((own,))))
    except ConfigError:
        return False
    return True
