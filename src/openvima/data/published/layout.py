"""What the files of one episode are called, and how large they may be."""

import re

PICKLES = ("obs.pkl", "action.pkl", "trajectory.pkl")
FRAME_FOLDERS = ("rgb_front", "rgb_top")
# An episode of 30 steps with eight prompt images has 4 MB; larger claims are damage or malice.
MAX_EPISODE_BYTES = 64 * 2**20
_FRAME = re.compile(rf"({'|'.join(FRAME_FOLDERS)})/([0-9]{{1,6}})\.jpg")


def is_episode_file(name: str) -> bool:
    """Whether an episode needs a file; the name is relative to its folder."""
    return name in PICKLES or frame_number(name) is not None


def frame_number(name: str) -> int | None:
    """Return the step of an image; None for other files."""
    match = _FRAME.fullmatch(name)
    return int(match[2]) if match else None
