"""`openvima data verify`: verify and repair demonstrations."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from openvima.cli.terminal import progress_bar
from openvima.errors import ConfigError

if TYPE_CHECKING:
    from openvima.data.verification import Repair, Verification


def verify(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    *,
    replay: str = "1",
    repair: bool = False,
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
        repair: Generate damaged shards again, or keep the whole records of those that cannot be generated.
        workers: Number of processes.
        seed: Decides which episodes are replayed.
        assets: Folder of the original benchmark's assets, or FILE.py:FUNCTION, for data made with them.
        as_json: Print the result as JSON.

    Returns:
        Exit status.
    """
    from openvima.data.hub import data_folder
    from openvima.data.verification import VerifyConfig
    from openvima.data.verification import repair as repair_folder
    from openvima.data.verification import verify as verify_folder

    folder = data_folder(folder)
    config = VerifyConfig(_number(replay), seed=seed, assets=assets, workers=workers)
    with progress_bar("repairing" if repair else "verifying") as report:
        done = repair_folder(folder, config, report) if repair else None
        found = done.after if done is not None else verify_folder(folder, config, report)
    if as_json:
        print(json.dumps((done or found).record(), indent=2, ensure_ascii=False))
    else:
        print("\n".join([*(() if done is None else _repair_text(done)), *_text(found)]))
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


def _repair_text(done: "Repair") -> Iterator[str]:
    """Yield the lines about a repair."""
    yield f"before: {_number_of_problems(done.before)}"
    yield from (f"  {problem.file}: {problem.cause}" for problem in done.before.problems)
    for title, names in (
        ("generated again", done.regenerated),
        ("whole records kept", done.rewritten),
        ("lost", done.lost),
        ("deleted", done.deleted),
    ):
        if names:
            yield title
            yield from (f"  {name}" for name in names)
    yield ""


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
