"""The statistics that LeRobot normalises with, of one episode or of all.

A quantile is the smallest value that at least this share of the values does not exceed. LeRobot itself
estimates quantiles from histograms, which gives the same up to a bin's width (a 5000th of the range).
"""

import numpy as np

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Statistics = dict[str, np.ndarray]


def value_statistics(values: np.ndarray) -> Statistics:
    """Return the statistics of numbers.

    Args:
        values: Shape (N, D) or (N,), any dtype, N at least 1.

    Returns:
        "min" and "max" in the dtype of the values, "mean", "std" and the quantiles in float64, all of shape
        (D,), and "count", shape (1,).
    """
    table = values.reshape(len(values), -1)
    ordered = np.sort(table, axis=0)
    ranks = {name: _rank(share, len(table)) for name, share in QUANTILES.items()}
    return {
        "min": ordered[0],
        "max": ordered[-1],
        "mean": table.mean(axis=0, dtype=np.float64),
        "std": table.std(axis=0, dtype=np.float64),
        "count": np.array([len(table)]),
        **{name: ordered[rank].astype(np.float64) for name, rank in ranks.items()},
    }


class PixelCounts:
    """How often each brightness occurs in the pictures of one feature, by channel."""

    def __init__(self) -> None:
        self.counts = np.zeros((3, 256), np.int64)
        self.num_frames = 0

    def add(self, pictures: np.ndarray, *, num_frames: int) -> None:
        """Count the pictures of an episode.

        Args:
            pictures: Shape (num_frames or 1, 3, height, width), uint8; one picture stands for all frames.
            num_frames: Frames of the episode.
        """
        self.num_frames += num_frames
        if not pictures.any():  # most prompts have fewer images than the longest
            self.counts[:, 0] += num_frames * pictures[0, 0].size
            return
        times = num_frames // len(pictures)
        for channel in range(3):
            self.counts[channel] += times * np.bincount(pictures[:, channel].reshape(-1), minlength=256)

    def merge(self, other: "PixelCounts") -> None:
        """Add what another has counted."""
        self.counts += other.counts
        self.num_frames += other.num_frames

    def statistics(self) -> Statistics:
        """Return the statistics of brightness from 0 to 1: shape (3, 1, 1), "count" is that of frames."""
        levels = np.arange(256) / 255
        num_pixels = self.counts[0].sum()
        mean = self.counts @ levels / num_pixels
        squares = self.counts @ levels**2 / num_pixels
        below = self.counts.cumsum(axis=1)
        ranks = {name: _rank(share, num_pixels) for name, share in QUANTILES.items()}
        moments = {
            "min": levels[(self.counts > 0).argmax(axis=1)],
            "max": levels[255 - (self.counts[:, ::-1] > 0).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(squares - mean**2, 0)),
        }
        quantiles = {name: levels[(below > rank).argmax(axis=1)] for name, rank in ranks.items()}
        return {
            **_by_channel(moments),
            "count": np.array([self.num_frames]),
            **_by_channel(quantiles),
        }


def _by_channel(statistics: Statistics) -> Statistics:
    return {name: row.reshape(3, 1, 1) for name, row in statistics.items()}


def _rank(share: float, count: int) -> int:
    """Place of a quantile among `count` sorted values, from 0."""
    return max(int(np.ceil(share * count - 1e-9)) - 1, 0)
