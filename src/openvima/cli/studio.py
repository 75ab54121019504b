"""`openvima studio`: episodes, policies and data in a browser."""

import logging
import sys
import threading
import webbrowser
from contextlib import closing
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from openvima.cli.terminal import parse_list


def main(
    path: Annotated[Positional[Path | None], arg(metavar="PATH")] = None,
    *,
    port: int = 0,
    open: bool = False,
    policies: str = "",
    record_demonstrations: Path | None = None,
    assets: str = "procedural",
    compat: bool = False,
    prompts: str = "multimodal",
    task_options: str = "",
    device: str = "cpu",
    trust_code: bool = False,
) -> None:
    """Open the studio until Ctrl-C: step through episodes, ask policies why, compose, act, browse.

    Every browser has a session of its own. Nothing leaves this machine.

    Example: openvima studio --open

    Args:
        path: Folder of an evaluation or of demonstrations to browse.
        port: TCP port; 0 takes a free one. The address is printed once the server answers.
        open: Open the page in a browser.
        policies: Policies to offer besides the bundled ones, oracle, random and you, with commas between
            them: what `openvima evaluate --policy` takes.
        record_demonstrations: Folder to which own successes are written as demonstrations of domain "user".
        assets: procedural, original (see `openvima assets import`), a checkout of the original benchmark,
            or FILE.py:FUNCTION, which registers assets of your own.
        compat: Follow the original benchmark also where it is odd.
        prompts: multimodal, text or mixed, as for `openvima demo`.
        task_options: Options of tasks, [TASK.]NAME=VALUE with commas between them.
        device: Where networks compute: cpu, in float64, or cuda, in float32.
        trust_code: Run the code that run folders name, as those of learners of your own do, and
            that which results name as their detector.
    """
    from openvima.imports import import_extra

    for module in ("viser", "trimesh"):
        import_extra(module, f"the studio needs {module}; install it with: pip install 'openvima[studio]'")
    from openvima.env import EnvConfig
    from openvima.errors import ConfigError
    from openvima.studio.app import Studio
    from openvima.studio.browser_session import StudioConfig

    if path is not None and not path.exists():
        raise ConfigError(f"there is no {path}; name the folder of an evaluation or of demonstrations.")
    config = StudioConfig(
        path,
        parse_list(policies),
        record_demonstrations,
        EnvConfig(assets, compat, prompts, task_options),
        device,
        trust_code,
        port,
    )
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    with closing(Studio(config)) as studio:
        print(studio.url, flush=True)
        if open:
            webbrowser.open(studio.url)
        threading.Event().wait()
