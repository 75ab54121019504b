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


class Settling:
    """Physics until every free body has been slow for 10 ticks, or the limit is reached.

    Args:
        bodies: The bodies.
        apart_from: Index of a body to ignore, such as a parked one.
        max_speed: Bound of the horizontal speed in m/s, for bodies that overlap at the start.
        sleeping: See `Bodies.tick`.
    """

    def __init__(
        self,
        bodies: Bodies,
        *,
        apart_from: int | None = None,
        max_speed: float | None = None,
        sleeping: Collection[int] = (),
    ) -> None:
        self._bodies = bodies
        self._apart_from = apart_from
        self._max_speed = max_speed
        self._sleeping = sleeping
        self._quiet = 0
        self.num_ticks = 0

    @property
    def is_at_rest(self) -> bool:
        """Whether every body has been slow for long enough."""
        return self._quiet >= _QUIET_STRIDES

    @property
    def is_over(self) -> bool:
        """Whether everything is at rest, or the limit is reached."""
        return self.is_at_rest or self.num_ticks >= SETTLE_LIMIT_TICKS

    def run(self, num_ticks: int = STRIDE_TICKS) -> None:
        """Run one stride; where it is the last one, stop all bodies."""
        before = self._bodies.coordinates()
        self._bodies.tick(num_ticks, sleeping=self._sleeping)
        if self._max_speed is not None:
            self._bodies.limit_speed(self._max_speed)
        self.num_ticks += num_ticks
        speed, turning = self._bodies.mean_speeds(before, num_ticks * TICK_S, apart_from=self._apart_from)
        is_slow = speed < SETTLED_SPEED and turning < SETTLED_TURNING
        self._quiet = self._quiet + 1 if is_slow else 0
        if self.is_over:
            self._bodies.stop()
            self._bodies.refresh()


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
        apart_from: See `Settling`.
        max_speed: See `Settling`.
        sleeping: See `Bodies.tick`.
        each: Called after every 5 ticks with the number of ticks.

    Returns:
        The number of ticks run, and whether everything came to rest within 1000 ticks.
    """
    settling = Settling(bodies, apart_from=apart_from, max_speed=max_speed, sleeping=sleeping)
    while not settling.is_over:
        settling.run()
        if each is not None:
            each(STRIDE_TICKS)
    return settling.num_ticks, settling.is_at_rest
