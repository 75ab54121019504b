"""`openvima data verify`: look for all that is wrong with demonstrations, and repair it."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from openvima.cli.progress import progress_bar
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
    """Look for all that is wrong with demonstrations: bytes, form, values, and episodes played again.

    Exit status 0 if nothing is wrong, else 1. Problems are named with file, cause and remedy.

    Example: openvima data verify demos --workers 2

    Args:
        folder: Folder of demonstrations.
        replay: Episodes of each task to play again in the simulator and to compare bit by bit, or "all".
        repair: Generate damaged shards again, or keep the whole records of those that were imported.
        workers: Number of processes.
        seed: Another one replays other episodes.
        assets: Folder of the original benchmark's assets, for data made with them.
        as_json: Print the result for machines.

    Returns:
        Exit status.
    """
    from openvima.data.verification import VerifyConfig
    from openvima.data.verification import repair as make_whole
    from openvima.data.verification import verify as look

    config = VerifyConfig(_number(replay), seed=seed, assets=assets, workers=workers)
    with progress_bar("repairing" if repair else "verifying") as report:
        done = make_whole(folder, config, report) if repair else None
        found = done.after if done is not None else look(folder, config, report)
    if as_json:
        print(json.dumps((done or found).record(), indent=2, ensure_ascii=False))
    else:
        print("\n".join([*(() if done is None else _deeds(done)), *_findings(found)]))
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


def _deeds(done: "Repair") -> Iterator[str]:
    """Say what a repair found and did."""
    yield f"before: {_number_of_problems(done.before)}"
    yield from (f"  {problem.file}: {problem.cause}" for problem in done.before.problems)
    for deed, names in (
        ("generated again", done.made_anew),
        ("whole records kept", done.rewritten),
        ("lost", done.lost),
        ("deleted", done.deleted),
    ):
        if names:
            yield deed
            yield from (f"  {name}" for name in names)
    yield ""


def _findings(found: "Verification") -> Iterator[str]:
    yield (
        f"{found.folder}: {found.num_shards:,} shards, {found.num_episodes:,} episodes compared with their "
        f"hashes, {found.num_replayed:,} played again{_tokens(found)}"
    )
    yield from (f"note: {note}" for note in found.notes)
    yield _number_of_problems(found)
    for problem in found.problems:
        yield f"  {problem.file}: {problem.cause}"
    yield from (f"  → {remedy}" for remedy in sorted({problem.remedy for problem in found.problems}))


def _tokens(found: "Verification") -> str:
    return f", {found.num_token_files:,} files of tokens compared" if found.num_token_files else ""


def _number_of_problems(found: "Verification") -> str:
    if found.is_clean:
        return "nothing is wrong"
    return "1 problem" if len(found.problems) == 1 else f"{len(found.problems)} problems"
