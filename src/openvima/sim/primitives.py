"""The two primitives: pick and place with the suction cup, sweep with the spatula.

Event-driven: physics is skipped while nothing can be in contact. A lifted body moves rigidly with the arm;
physics runs when it is released onto anything but bare floor, when the spatula touches bodies, and until
everything is at rest.
"""

import math
from dataclasses import dataclass

import numpy as np

from openvima.scene import Action, Pose
from openvima.sim import end_effectors as tools
from openvima.sim import ur5
from openvima.sim.arm_path import reachable_joints
from openvima.sim.bodies import Bodies
from openvima.sim.contacts import body_gap, distance_to_contact, gap
from openvima.sim.model import FLOOR_Z_M
from openvima.sim.primitive_state import RESTING_GAP_M, PrimitiveState, is_level
from openvima.sim.spatula import Spatula

_DOWN = (0.0, 0.0, -1.0)
_ABOVE_ALL_M = 1.0  # height from which tools and held bodies are lowered, above every stack


def pick_place(state: PrimitiveState, action: Action) -> int | None:
    """Lower the suction cup at pose0, lift the grasped body, and set it down at pose1.

    The body keeps its pose relative to the tool and is released at first contact.

    Args:
        state: Bodies and arm; afterwards everything is at rest.
        action: Where to pick and to place.

    Returns:
        Index of the moved body; None if the cup hit the floor or a fixed body.
    """
    bodies, path = state.bodies, state.path
    x, y = action.pose0_position
    hover = reachable_joints(x, y, tools.HOVER_TIP_Z_M, action.yaw0_rad)
    path.move(hover, scene=lambda _: state.start)
    caught, surface_z = body_under_probe(bodies, x, y)
    contact_z = surface_z + tools.PROBE_BELOW_TIP_M
    path.move(reachable_joints(x, y, contact_z, action.yaw0_rad), scene=lambda _: state.start)
    if caught is None or caught not in bodies.rigid:
        path.move(hover, scene=lambda _: state.start)
        return None
    held = _HeldBody(caught, bodies.pose(caught), action, contact_z)
    stands_alone = _lift(state, held)
    path.move(hover, scene=lambda joints: state.scene(held.at(joints)))
    _set_down(state, held, stands_alone=stands_alone)
    return caught


def body_under_probe(bodies: Bodies, x: float, y: float) -> tuple[int | None, float]:
    """Find the body that a probe lowered at (x, y), in metres, hits, and at what height.

    Of the bodies that the probe hits, the highest; if it hits none, the nearest within the capture radius. On
    its way down to a fixed body, such as the floor of a container, it grasps a free one close beside it.
    Distances include contact margins, so hulls are grasped up to 4 mm beside their edge.

    Returns:
        Index of the body, or None for the floor; height of its surface in metres.
    """
    gaps = _gaps_to_axis(bodies, x, y)
    nearest = min(gaps, key=gaps.__getitem__, default=None)
    if nearest is None or gaps[nearest] > tools.CAPTURE_RADIUS_M:
        return None, FLOOR_Z_M
    tops = {
        index: _surface_z(bodies, index, x, y) for index in gaps if gaps[index] <= tools.CONTACT_RADIUS_M
    } or {nearest: _surface_z(bodies, nearest, x, y)}
    highest = max(tops, key=tops.__getitem__)
    if highest not in bodies.rigid:
        beside = {index: gaps[index] for index in gaps if index in bodies.rigid}
        flank = min(beside, key=beside.__getitem__, default=highest)
        top = bodies.highest_z(flank)
        if gaps[flank] <= tools.FLANK_RADIUS_M and top > tops[highest]:
            return flank, top
    return highest, tops[highest]


def _gaps_to_axis(bodies: Bodies, x: float, y: float) -> dict[int, float]:
    """Distances in metres of the bodies near a vertical line to it; negative where it pierces one."""
    bodies.place_probe(x, y, FLOOR_Z_M)
    bodies.refresh()
    probe = bodies.probe_geom
    return {
        index: min((gap(bodies, probe, geom) for geom in bodies.geoms(index)), default=math.inf)
        for index, shape in enumerate(bodies.shapes)
        if math.hypot(bodies.pose(index).x - x, bodies.pose(index).y - y)
        < shape.radius_m + tools.CAPTURE_RADIUS_M
    }


def _surface_z(bodies: Bodies, index: int, x: float, y: float) -> float:
    """Height at which a probe lowered at (x, y) hits a body; the top of the body if it misses."""
    bodies.place_probe(x, y, _ABOVE_ALL_M)
    bodies.refresh()
    probe = (bodies.probe_geom,)
    depth = _ABOVE_ALL_M - FLOOR_Z_M
    drop = distance_to_contact(bodies, probe, bodies.geoms(index), direction=_DOWN, length_m=depth)
    return bodies.highest_z(index) if drop is None else _ABOVE_ALL_M - drop


@dataclass(frozen=True, slots=True)
class _HeldBody:
    """A body on the suction cup: its pose at the grasp, the action, and the tip's height at the grasp."""

    index: int
    grasped_at: Pose
    action: Action
    contact_z: float

    def at(self, joints: np.ndarray) -> tuple[int, Pose]:
        """Index and pose for the arm at `joints`."""
        x, y = self.action.pose0_position
        tip = ur5.tool_pose(x, y, self.contact_z, self.action.yaw0_rad)
        return self.index, ur5.forward(joints) @ tip.inverse() @ self.grasped_at

    def target(self) -> Pose:
        """Pose above pose1 at the height of the grasp: the grasp pose carried along with the tool."""
        pick = Pose.planar(*self.action.pose0_position, self.action.yaw0_rad)
        place = Pose.planar(*self.action.pose1_position, self.action.yaw1_rad)
        return place @ pick.inverse() @ self.grasped_at


def _lift(state: PrimitiveState, held: _HeldBody) -> bool:
    """Take a body out of the physics and let others settle; return whether it touched no other."""
    bodies = state.bodies
    touching = [
        other
        for other in range(len(bodies.shapes))
        if other != held.index and body_gap(bodies, held.index, other) < RESTING_GAP_M
    ]
    on_floor = held.grasped_at.z + bodies.lowest_z(held.index, held.grasped_at.quaternion) - FLOOR_Z_M
    bodies.park(held.index)
    if any(other in bodies.rigid for other in touching):
        state.settle((held.index, held.grasped_at.moved(dz=tools.HOVER_TIP_Z_M)))
    return not touching and on_floor < RESTING_GAP_M and is_level(held.grasped_at)


def _set_down(state: PrimitiveState, held: _HeldBody, *, stands_alone: bool) -> None:
    """Carry a body to pose1, lower it to first contact, release it and settle."""
    bodies, path = state.bodies, state.path
    x, y = held.action.pose1_position
    yaw_rad = held.action.yaw1_rad
    target = held.target()
    drop, on_floor = _distance_down(bodies, held.index, target.moved(dz=_ABOVE_ALL_M))
    set_down_at = target.moved(dz=_ABOVE_ALL_M - drop)
    hover = reachable_joints(x, y, tools.HOVER_TIP_Z_M, yaw_rad)
    contact_z = held.contact_z + set_down_at.z - target.z
    path.move(hover, scene=lambda joints: state.scene(held.at(joints)))
    path.move(reachable_joints(x, y, contact_z, yaw_rad), scene=lambda joints: state.scene(held.at(joints)))
    if on_floor and stands_alone:  # no physics needed, and its height keeps the same value
        bodies.place(held.index, target)
        bodies.refresh()
    else:
        bodies.place(held.index, set_down_at)
        bodies.refresh()
        state.settle()
    after = state.scene() if path.is_recording else state.start
    path.move(hover, scene=lambda _: after)


def _distance_down(bodies: Bodies, index: int, above: Pose) -> tuple[float, bool]:
    """How far a body can be lowered from `above` to first contact, and whether that is bare floor."""
    bodies.place(index, above)
    bodies.refresh()
    to_floor = above.z + bodies.lowest_z(index, above.quaternion) - FLOOR_Z_M
    reach = bodies.shapes[index].radius_m
    others = [
        geom
        for other, shape in enumerate(bodies.shapes)
        if other != index and bodies.pose(other).planar_distance(above) < reach + shape.radius_m
        for geom in bodies.geoms(other)
    ]
    to_others = distance_to_contact(bodies, bodies.geoms(index), others, direction=_DOWN, length_m=to_floor)
    if to_others is None:
        return to_floor, True
    return min(to_floor, to_others), False


def sweep(state: PrimitiveState, action: Action, *, compat: bool = False) -> None:
    """Push with the spatula from just before pose0 towards pose1, in a straight line at constant speed.

    Rotations of the action are ignored. Nothing happens if the two points are equal.

    Args:
        state: Bodies and arm; afterwards everything is at rest.
        action: Start and end.
        compat: Move straight in joint space, as VIMA-Bench does, and stop 3 mm earlier.
    """
    (x0, y0), (x1, y1) = action.pose0_position, action.pose1_position
    distance = math.hypot(x1 - x0, y1 - y0)
    if distance == 0:
        return
    shortfall_m = tools.SPATULA_SHORTFALL_M + (tools.COMPAT_SHORTFALL_M if compat else 0.0)
    vx, vy = (x1 - x0) / distance, (y1 - y0) / distance
    start = _within_reach(x0 - tools.SPATULA_RUN_UP_M * vx, y0 - tools.SPATULA_RUN_UP_M * vy)
    end = _within_reach(x1 - shortfall_m * vx, y1 - shortfall_m * vy)
    # A sweep shorter than run-up and shortfall overshoots, then returns, as in VIMA-Bench.
    nudge = distance + tools.SPATULA_RUN_UP_M - shortfall_m
    legs = [end] if nudge >= 0 else [_within_reach(start[0] - nudge * vx, start[1] - nudge * vy), end]
    spatula = Spatula(state, math.atan2(vy, vx), in_joint_space=compat)
    spatula.lower(*start)
    for x, y in legs:
        spatula.push(x, y)
    spatula.lift()


def _within_reach(x: float, y: float) -> tuple[float, float]:
    """Move a point towards the base until the lowered tool reaches it."""
    farthest = ur5.farthest_tip_distance(tools.SWEEP_TIP_Z_M) - 1e-6
    shrink = min(1.0, farthest / math.hypot(x, y))
    return x * shrink, y * shrink
