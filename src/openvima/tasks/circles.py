"""Circles around shapes on the table."""

import numpy as np

_NUM_STEPS = 1000  # the error falls as one over this number


def middle_of_smallest_circle(points: np.ndarray) -> tuple[float, float]:
    """Return the centre of the smallest circle around points of the plane.

    Args:
        points: Shape (N, 2), float64, metres.

    Returns:
        x, y in metres, to about a thousandth of the circle's radius.

    Source: Bădoiu and Clarkson, "Smaller core-sets for balls" (2003): ever shorter steps towards the point
    that is farthest.
    """
    points = np.unique(points, axis=0)
    middle = points[0]
    for step in range(2, _NUM_STEPS):
        away = points - middle
        farthest = int(np.argmax(away[:, 0] ** 2 + away[:, 1] ** 2))
        middle = middle + away[farthest] / step
    x, y = middle.tolist()
    return x, y
