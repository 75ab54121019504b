"""Running the physics until everything is at rest."""

from collections.abc import Callable, Collection

from openvima.sim.bodies import Bodies
from openvima.sim.model import TICK_S

SETTLED_SPEED = 5e-3  # m/s, as in VIMA-Bench
SETTLED_TURNING = 0.05  # rad/s: a body that topples rotates before its centre moves
SETTLE_LIMIT_TICKS = 1000
MONITOR_TICKS = 25  # interval of constraint checks
STRIDE_TICKS = 5  # interval of speed checks; divides MONITOR_TICKS
_QUIET_STRIDES = 2  # consecutive, so that a body that reverses its motion does not count as settled


def settle(
    bodies: Bodies,
    *,
    apart_from: int | None = None,
    max_speed: float | None = None,
    sleeping: Collection[int] = (),
    each: Callable[[int], None] | None = None,
) -> tuple[int, bool]:
    """Run until every free body has been slow for 10 ticks, or the limit is reached; then stop all bodies.

    Args:
        bodies: The bodies; their velocities are zero afterwards.
        apart_from: Index of a body to ignore, such as a parked one.
        max_speed: Bound of the horizontal speed in m/s, for bodies that overlap at the start.
        sleeping: See `Bodies.tick`.
        each: Called after every 5 ticks with the number of ticks.

    Returns:
        The number of ticks run, and whether everything came to rest within 1000 ticks.
    """
    num_ticks = quiet = 0
    while quiet < _QUIET_STRIDES and num_ticks < SETTLE_LIMIT_TICKS:
        before = bodies.coordinates()
        bodies.tick(STRIDE_TICKS, sleeping=sleeping)
        if max_speed is not None:
            bodies.limit_speed(max_speed)
        num_ticks += STRIDE_TICKS
        speed, turning = bodies.mean_speeds(before, STRIDE_TICKS * TICK_S, apart_from=apart_from)
        quiet = quiet + 1 if speed < SETTLED_SPEED and turning < SETTLED_TURNING else 0
        if each is not None:
            each(STRIDE_TICKS)
    bodies.stop()
    bodies.refresh()
    return num_ticks, quiet >= _QUIET_STRIDES
