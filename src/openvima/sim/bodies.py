"""Bodies in MuJoCo, suction probe and spatula included: poses, velocities, and distances to contact."""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's names come from a compiled module without type stubs.)

import itertools
import math
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np

from openvima.catalog.geometry import Assets, Vector3
from openvima.scene import Pose, Scene
from openvima.scene.scene import Quaternion, normalised
from openvima.sim.model import PARKED_M, PROBE_HALF_LENGTH_M, TICK_S, body_shape, build_model

_FASTEST = np.array([1.0, 1.0, 1.0, 1 / 0.015, 1 / 0.015, 1 / 0.015])  # rad/s per m/s: half a small block
MAX_SPEED = 0.5  # m/s, of bodies squeezed out between the spatula and a fixed body
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION  # all that later ticks depend on
_SLOWEST = -_FASTEST - np.array([0.0, 0.0, np.inf, 0.0, 0.0, 0.0])  # falling is free


class Bodies:
    """The bodies of one scene in MuJoCo.

    Bodies are indexed as the scene's placements. Poses are those of link frames.

    Args:
        scene: The scene to load; all bodies start at rest.
        assets: Asset pack.

    Attributes:
        geoms: MuJoCo ids of the convex parts of each body.
        sleeping: Indices of free bodies at rest that nothing can touch for now; physics leaves them out.
    """

    def __init__(self, scene: Scene, assets: Assets) -> None:
        self.shapes = tuple(body_shape(p.object, p.geometry(assets), p.fixed) for p in scene.placements)
        with_spatula = scene.end_effector == "spatula"
        self._load_model(with_spatula)
        rigid = [index for index, shape in enumerate(self.shapes) if not shape.fixed]
        fixed = [index for index, shape in enumerate(self.shapes) if shape.fixed]
        self.rigid = tuple(rigid)
        self._joint = {index: rank for rank, index in enumerate(rigid)}
        self._mocap = {index: rank for rank, index in enumerate(fixed)}
        first, count = self.model.body_geomadr, self.model.body_geomnum
        self.geoms = tuple(
            range(int(first[i + 1]), int(first[i + 1] + count[i + 1])) for i in range(len(self.shapes))
        )
        self.sleeping: set[int] = set()
        self._has_walls = any(self.geoms[index] for index in fixed)
        self._probe_mocap = len(fixed)
        self.probe_geom = int(first[len(self.shapes) + 1])
        self.spatula_geom = int(first[len(self.shapes) + 2]) if with_spatula else -1
        for index, placement in enumerate(scene.placements):
            self.place(index, placement.pose)
        self.park_spatula()
        self.refresh()

    def _load_model(self, with_spatula: bool) -> None:
        self.model = build_model(self.shapes, with_spatula=with_spatula)
        self.data = mujoco.MjData(self.model)
        self._positions = self.data.qpos.reshape(-1, 7)  # views: writing to them moves the bodies
        self._velocities = self.data.qvel.reshape(-1, 6)

    def __getstate__(self) -> dict[str, Any]:
        state = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, state, _STATE)
        rebuilt = ("model", "data", "_positions", "_velocities")
        return {key: value for key, value in vars(self).items() if key not in rebuilt} | {"state": state}

    def __setstate__(self, attributes: dict[str, Any]) -> None:
        state = attributes.pop("state")
        vars(self).update(attributes)
        self._load_model(with_spatula=self.spatula_geom >= 0)
        mujoco.mj_setState(self.model, self.data, state, _STATE)
        self.refresh()

    def pose(self, index: int) -> Pose:
        """Current pose of a body's link frame."""
        if index in self._mocap:
            row = self._mocap[index]
            numbers = [*self.data.mocap_pos[row].tolist(), *self.data.mocap_quat[row].tolist()]
        else:
            numbers = self._positions[self._joint[index]].tolist()
        x, y, z, qw, qx, qy, qz = numbers
        return Pose((x, y, z), (qx, qy, qz, qw))

    def place(self, index: int, pose: Pose) -> None:
        """Set the pose of a body, at rest. Call `refresh` before computing distances."""
        numbers = _numbers(pose)
        if index in self._mocap:
            row = self._mocap[index]
            self.data.mocap_pos[row] = numbers[:3]
            self.data.mocap_quat[row] = numbers[3:]
            return
        self._positions[self._joint[index]] = numbers
        self._velocities[self._joint[index]] = 0.0

    def park(self, index: int) -> None:
        """Move a free body out of contact; it falls there until it is placed again."""
        self.place(index, Pose((0.0, 0.0, PARKED_M)))

    def place_probe(self, x: float, y: float, z: float) -> None:
        """Set the position of the lower end of the probe, metres."""
        self.data.mocap_pos[self._probe_mocap] = (x, y, z + PROBE_HALF_LENGTH_M)

    def place_spatula(self, pose: Pose) -> None:
        """Set the pose of the spatula's centre, at rest."""
        self._positions[-1] = _numbers(pose)
        self._velocities[-1] = 0.0

    def park_spatula(self) -> None:
        """Move the spatula out of contact."""
        if self.spatula_geom >= 0:
            self.place_spatula(Pose((0.0, 0.0, 2 * PARKED_M)))

    def refresh(self) -> None:
        """Update the geometry to the poses that were set."""
        mujoco.mj_kinematics(self.model, self.data)

    def tick(self, num_ticks: int) -> None:
        """Advance the physics by some ticks."""
        rows = [self._joint[index] for index in self.sleeping]
        if not rows:
            mujoco.mj_step(self.model, self.data, num_ticks)
            return
        before = self._positions[rows]
        self._positions[rows, 2] += PARKED_M
        mujoco.mj_step(self.model, self.data, num_ticks)
        self._positions[rows], self._velocities[rows] = before, 0.0

    def tick_with_spatula(
        self, pose: Pose, velocity: Vector3, num_ticks: int, *, turning: float = 0.0
    ) -> None:
        """Advance the physics while the spatula moves at constant velocity, unaffected by contacts.

        Speeds are limited at the end. With fixed bodies, after every tick: a body squeezed between one and
        the spatula accelerates too fast for a later limit.

        Args:
            pose: The spatula's centre at the start.
            velocity: Velocity of the spatula, m/s.
            num_ticks: Number of ticks.
            turning: Angular velocity of the upright spatula, rad/s; its heading follows after the last tick.
        """
        place, speed = np.array(_numbers(pose)), np.array((*velocity, 0.0, 0.0, turning))
        stride = 1 if self._has_walls else num_ticks
        for _ in range(0, num_ticks, stride):
            self._positions[-1], self._velocities[-1] = place, speed
            self.tick(stride)
            self.limit_speed(MAX_SPEED)
            place[:3] += speed[:3] * (stride * TICK_S)

    def stop(self) -> None:
        """Set all velocities to zero."""
        self.data.qvel[:] = 0.0
        self.data.qacc_warmstart[:] = 0.0

    def limit_speed(self, max_speed: float) -> None:
        """Clip the velocities of free bodies, except downwards.

        Args:
            max_speed: Bound of every velocity component except downwards, in m/s; angular velocity is bounded
                so that the faces of the smallest block keep that speed.
        """
        velocities = self._velocities[: len(self.rigid)]
        np.clip(velocities, max_speed * _SLOWEST, max_speed * _FASTEST, out=velocities)

    def speeds(self) -> tuple[float, float]:
        """Largest component of linear (m/s) and angular (rad/s) velocity of the free bodies."""
        velocities = np.abs(self._velocities[: len(self.rigid)])
        return float(velocities[:, :3].max(initial=0.0)), float(velocities[:, 3:].max(initial=0.0))

    def coordinates(self) -> np.ndarray:
        """Current positions and quaternions of the free bodies, shape (N, 7), a copy."""
        return self._positions[: len(self.rigid)].copy()

    def mean_speeds(self, since: np.ndarray, duration_s: float) -> tuple[float, float]:
        """Largest component of mean linear (m/s) and angular (rad/s) velocity, of bodies not parked.

        A body that jitters in place has a velocity, but no mean velocity.

        Args:
            since: Earlier `coordinates`.
            duration_s: Time since then.
        """
        in_play = since[:, 2] < PARKED_M / 2
        change = np.abs(self._positions[: len(self.rigid)] - since)[in_play] / duration_s
        return float(change[:, :3].max(initial=0.0)), 2 * float(change[:, 3:].max(initial=0.0))

    def shift(self, indices: Iterable[int], offset: Vector3) -> None:
        """Translate free bodies by metres in the world frame; they keep their velocities."""
        for index in indices:
            self._positions[self._joint[index], :3] += offset

    def lowest_z(self, index: int, quaternion: Quaternion) -> float:
        """Height of a body's lowest contact point above its link frame, in metres, for an orientation."""
        points = self.shapes[index].points
        heights = _heights(points, quaternion) - points[:, 3]
        return float(heights.min(initial=np.inf))

    def highest_z(self, index: int) -> float:
        """Current height of a body's highest contact point, in metres."""
        pose = self.pose(index)
        points = self.shapes[index].points
        heights = _heights(points, pose.quaternion) + points[:, 3]
        return pose.z + float(heights.max(initial=-np.inf))


def _heights(points: np.ndarray, quaternion: Quaternion) -> np.ndarray:
    """Heights above its link frame, shape (N,), of points of a body with that orientation."""
    return Pose((0.0, 0.0, 0.0), quaternion).transform(points[:, :3])[:, 2]


def _numbers(pose: Pose) -> tuple[float, ...]:
    x, y, z, w = normalised(pose.quaternion)
    return (*pose.position, w, x, y, z)


CONTACT_M = 1e-5  # gaps below this count as contact
_FARTHEST_M = 10.0  # beyond this, distances are not computed
_MOST_STEPS = 50


def gap(bodies: Bodies, geom1: int, geom2: int) -> float:
    """Distance of two convex parts in metres, less their margins; negative if they overlap."""
    reach = bodies.model.geom_margin[geom1] + bodies.model.geom_margin[geom2]
    return mujoco.mj_geomDistance(bodies.model, bodies.data, geom1, geom2, _FARTHEST_M, None) - float(reach)


def body_gap(bodies: Bodies, index1: int, index2: int) -> float:
    """Smallest gap of two bodies in metres; infinite if their bounding circles are apart."""
    reach = bodies.shapes[index1].radius_m + bodies.shapes[index2].radius_m
    if bodies.pose(index1).planar_distance(bodies.pose(index2)) > reach + 0.01:
        return np.inf
    pairs = itertools.product(bodies.geoms[index1], bodies.geoms[index2])
    return min((gap(bodies, *pair) for pair in pairs), default=np.inf)


def distance_to_contact(
    bodies: Bodies, moving: Iterable[int], others: Iterable[int], *, direction: Vector3, length_m: float
) -> float:
    """How far some parts can move before one of them touches one of the others; nothing is moved.

    Args:
        bodies: The bodies, refreshed.
        moving: MuJoCo ids of the parts that move together.
        others: MuJoCo ids of the static parts.
        direction: Unit vector.
        length_m: Largest distance.

    Returns:
        Metres, 0 if they touch already; infinite without contact.
    """
    pairs = itertools.product(moving, others)
    along = np.array(direction)
    return min((_pair_distance_to_contact(bodies, *pair, along, length_m) for pair in pairs), default=np.inf)


def _pair_distance_to_contact(
    bodies: Bodies, geom: int, other: int, direction: np.ndarray, length_m: float
) -> float:
    """How far one part can move before it touches another; infinite without contact.

    The distance of two convex shapes is a convex function of the translation of one of them. Newton's method,
    started without contact, therefore never overshoots, and converges in a few evaluations. The slope is that
    of the segment between the nearest points. The part is moved meanwhile, and put back.
    """
    model, positions = bodies.model, bodies.data.geom_xpos
    margin = float(model.geom_margin[geom] + model.geom_margin[other])
    start = positions[geom].copy()
    offset = positions[other] - start
    sideways = offset - direction * _dot(offset, direction)
    if _dot(sideways, sideways) > float(model.geom_rbound[geom] + model.geom_rbound[other] + margin) ** 2:
        return np.inf
    segment = np.zeros(6)
    way = 0.0
    found = np.inf
    for _ in range(_MOST_STEPS):
        positions[geom] = start + way * direction
        distance = mujoco.mj_geomDistance(model, bodies.data, geom, other, _FARTHEST_M, segment) - margin
        if distance < CONTACT_M:
            found = way
            break
        towards = segment[3:] - segment[:3]
        closing = _dot(towards, direction) / math.hypot(*towards.tolist())
        if closing <= 1e-6:  # the nearest points no longer approach each other: a miss
            break
        way += distance / closing
        if way > length_m:
            break
    positions[geom] = start
    return found


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Scalar product, written out: the last bits of NumPy's depend on the CPU."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return ax * bx + ay * by + az * bz
