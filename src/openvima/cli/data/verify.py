"""`openvima data verify`: verify demonstrations."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from openvima.cli.terminal import progress_bar
from openvima.errors import ConfigError

if TYPE_CHECKING:
    from openvima.data.verification import Verification


def verify(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    *,
    replay: str = "1",
    workers: int = 1,
    seed: int = 0,
    assets: str | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Verify demonstrations: checksums, schema, values, and replayed episodes.

    Exit status 0 if there are no problems, else 1. Problems are listed with file, cause and remedy.

    Example: openvima data verify demos --workers 2

    Args:
        folder: Folder of demonstrations, or hf://OWNER/NAME[@REVISION] on the Hugging Face Hub.
        replay: Episodes of each task to replay in the simulator and compare bit by bit, or "all".
        workers: Number of processes.
        seed: Decides which episodes are replayed.
        assets: Folder of the original benchmark's assets, or FILE.py:FUNCTION, for data made with them.
        as_json: Print the result as JSON.

    Returns:
        Exit status.
    """
    from openvima.data.reader import data_folder
    from openvima.data.verification import VerifyConfig
    from openvima.data.verification import verify as verify_folder

    folder = data_folder(folder)
    config = VerifyConfig(_number(replay), seed=seed, assets=assets, workers=workers)
    with progress_bar("verifying") as report:
        found = verify_folder(folder, config, report)
    if as_json:
        print(json.dumps(found.record(), indent=2, ensure_ascii=False))
    else:
        print("\n".join(_text(found)))
    return 0 if found.is_clean else 1


def _number(replay: str) -> int | None:
    """Read `--replay`.

    Raises:
        ConfigError: It is neither a number nor "all".
    """
    if replay == "all":
        return None
    if not replay.isdecimal():
        raise ConfigError(f"--replay is {replay!r}; give a number of episodes a task, 0 for none, or all.")
    return int(replay)


def _text(found: "Verification") -> Iterator[str]:
    yield (
        f"{found.folder}: {found.num_shards:,} shards, {found.num_episodes:,} episodes compared with their "
        f"hashes, {found.num_replayed:,} replayed{_cache_text(found)}"
    )
    yield from (f"note: {note}" for note in found.notes)
    yield _number_of_problems(found)
    for problem in found.problems:
        yield f"  {problem.file}: {problem.cause}"
    yield from (f"  → {remedy}" for remedy in sorted({problem.remedy for problem in found.problems}))


def _cache_text(found: "Verification") -> str:
    return f", {found.num_cache_files:,} cache files compared" if found.num_cache_files else ""


def _number_of_problems(found: "Verification") -> str:
    if found.is_clean:
        return "no problems"
    return "1 problem" if len(found.problems) == 1 else f"{len(found.problems)} problems"
