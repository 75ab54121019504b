"""Arguments that several commands take."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")]
Out = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
Policy = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")]
Repository = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="OWNER/NAME")]
Task = Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
Json = Annotated[bool, tyro.conf.arg(name="json")]


@dataclass(frozen=True, slots=True)
class EnvironmentOptions:
    """Tasks, prompts and control.

    Args:
        assets: procedural, original (see `openvima assets import`), a checkout of the original benchmark,
            or FILE.py:FUNCTION, which registers assets of your own.
        compat: Reproduce the quirks of the original benchmark; docs/compat.md lists them.
        prompts: multimodal; text, which puts a description such as "the red swirl letter A" in place of each
            object image; or mixed, which does so with probability ½. With ",paraphrased": synonyms.
        task_options: Options of tasks, [TASK.]NAME=VALUE with commas between them, such as
            num_distractors=3,rotate.difficulty=hard; `openvima tasks NAME` lists them. Without a task, for
            all that have the option.
        control: primitives; or end_effector, where an action moves the tool for 0.1 s (see
            docs/end_effector.md), for policies of that control and the oracle.
    """

    assets: str = "procedural"
    compat: bool = False
    prompts: str = "multimodal"
    task_options: str = ""
    control: Literal["primitives", "end_effector"] = "primitives"


Environment = tyro.conf.OmitArgPrefixes[EnvironmentOptions]
DEFAULT_ENVIRONMENT = EnvironmentOptions()
