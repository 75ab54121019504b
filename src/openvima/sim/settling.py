"""Letting the physics run until nothing moves."""

from collections.abc import Callable

from openvima.sim.bodies import Bodies
from openvima.sim.model import TICK_S

SETTLED_SPEED = 5e-3  # m/s, as in VIMA-Bench
SETTLED_TURNING = 0.05  # rad/s: a body that begins to topple turns before its centre moves
SETTLE_LIMIT_TICKS = 1000
WATCH_TICKS = 25  # longest stretch of motion between two looks at the constraints
STRIDE_TICKS = 5  # longest stretch of motion between two looks at the speeds; divides WATCH_TICKS
_QUIET_STRIDES = 2  # in a row, so that a body at the turning point of its motion does not count as settled


def settle(
    bodies: Bodies,
    *,
    apart_from: int | None = None,
    top_speed: float | None = None,
    each: Callable[[int], None] | None = None,
) -> tuple[int, bool]:
    """Run until every free body has been slow for 10 ticks, or the limit is reached; then stop all.

    Args:
        bodies: The bodies; their velocities are zero afterwards.
        apart_from: A body whose motion does not count, such as a parked one.
        top_speed: Bound of the horizontal speed in m/s, for bodies that begin inside one another: they shall
            part, not fly apart.
        each: Called after every 5 ticks with that number.

    Returns:
        The number of ticks run, and whether everything came to rest within 1000 ticks.
    """
    num_ticks = quiet = 0
    while quiet < _QUIET_STRIDES and num_ticks < SETTLE_LIMIT_TICKS:
        before = bodies.coordinates()
        bodies.tick(STRIDE_TICKS)
        if top_speed is not None:
            bodies.limit_speed(top_speed)
        num_ticks += STRIDE_TICKS
        speed, turning = bodies.mean_speeds(before, STRIDE_TICKS * TICK_S, apart_from=apart_from)
        quiet = quiet + 1 if speed < SETTLED_SPEED and turning < SETTLED_TURNING else 0
        if each is not None:
            each(STRIDE_TICKS)
    bodies.stop()
    bodies.refresh()
    return num_ticks, quiet >= _QUIET_STRIDES
