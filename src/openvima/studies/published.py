"""Does a public checkpoint reach its published numbers?"""

from openvima.env.config import EnvConfig
from openvima.errors import ConfigError
from openvima.report.published import published_models
from openvima.studies.study import L4_TASKS, TRAINING_TASKS, PublishedPoint, Run, Study, StudyInputs

LEVELS = ("L1", "L2", "L3", "L4")


def published(inputs: StudyInputs) -> Study:
    """A converted public checkpoint in `compat` environments with the original assets.

    Raises:
        ConfigError: The checkpoint or the assets are not given.
    """
    if inputs.checkpoint is None:
        raise ConfigError(
            "study published needs --checkpoint, the folder that `openvima policies convert 200M.ckpt FOLDER "
            "--tokenizer t5-base` writes."
        )
    if inputs.assets == "procedural":
        raise ConfigError(
            "study published needs --assets, a checkout of the original benchmark, or 'original' after "
            "`openvima assets import`."
        )
    return Study(
        name="published",
        question="Does the public checkpoint reach its published numbers?",
        quantity="level",
        runs=(Run("checkpoint", policy=f"checkpoint={inputs.checkpoint}"),),
        evaluation=inputs.evaluation(
            (*TRAINING_TASKS, *L4_TASKS), LEVELS, env_config=EnvConfig(inputs.assets, compat=True)
        ),
        x_axis="level",
        published=tuple(
            PublishedPoint(f"{model.model} {model.size}", level, level, rate / 100, model.mark(level))
            for model in published_models()
            if model.model == "VIMA" and model.data_fraction == 1
            for level, rate in model.levels.items()
        ),
        notes=("Objects are cropped by the segmentation; some published results use a detector.",),
    )
