"""The MuJoCo model of a scene: floor, free and fixed bodies, suction probe and spatula.

A model depends on the shapes alone, so that models and their convex hulls are shared between scenes; poses
are in `MjData`.

Contact parameters: MuJoCo's contacts are springs. `_SPRING` makes them as stiff as 1/240 s
allows, so that a body at rest sinks in by micrometres.

VIMA-Bench multiplies the friction coefficients of a pair; MuJoCo takes the larger one. No coefficient exceeds
1, so the body with less friction gets priority; pairs of two bodies below 1 are listed with their product.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's names come from a compiled module without type stubs.)

import hashlib
import logging
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from openvima.catalog.geometry import CollisionBox, CollisionShape, Geometry, Vector3
from openvima.catalog.objects import ObjectSpec, object_spec
from openvima.sim.ur5 import PROBE_RADIUS_M, SPATULA_HALF_SIZE_M

# By default MuJoCo writes warnings to a file in the working directory.
mujoco.set_mju_user_warning(logging.getLogger(__name__).warning)
# By default MuJoCo caches up to 500 MB of hulls; containers come in any size, so few recur, and
# compiling is as fast with 8 MB.
mujoco.mj_setCacheCapacity(mujoco.mj_getCache(), 8 << 20)

TICK_S = 1 / 240
GRAVITY_M_S2 = 9.8
FLOOR_Z_M = -0.001  # top of the floor; the visible sheet is at 0
HULL_MARGIN_M = 0.001  # hulls touch at this distance, as in the benchmark
BOX_MARGIN_M = 1e-5  # at 0, a box that just touches the floor would fall freely for one tick

_SPRING = {
    "condim": 3,
    "solref": [
        0.0125,
        1.0,
    ],  # s, damping ratio: three ticks, critically damped; at two, round bodies gain energy
    "solimp": [0.99, 0.999, 0.001, 0.5, 2.0],
}
_INERTIA_FACTOR = 3.0  # angular inertia of the benchmark's bodies
_INERTIA_GROWTH_M = 0.003  # by which hull bounds are grown for that, on every side
_TURNING_DAMPING_PER_S = 3.0  # else discs keep wobbling; its linear effect is 100 times smaller
_SPATULA_MASS_KG = 17.0  # stopping it within a tick takes about the 500 N of VIMA-Bench's tool mount
PARKED_M = 1000.0  # height of bodies out of contact
_MEMORY_BYTES = 64 << 20  # reserved; crowded scenes use 0.3 MB, a heap of overlapping bodies 5 MB
PROBE_HALF_LENGTH_M = 0.2
_COLLIDES, _COLLIDES_WITH_SPATULA = 1, 2  # bits of contype and conaffinity


@dataclass(frozen=True, slots=True, eq=False)
class BodyShape:
    """One body without its pose.

    Args:
        shapes: Convex parts in the link frame.
        points: Corners of all parts with their margins, shape (N, 4): x, y, z, margin; metres.
        radius_m: Largest distance of a corner from the link frame, margin included.
        spec: Catalogue entry.
        fixed: Welded to the floor.
        inertia: Principal moments in kg m².
    """

    shapes: tuple[CollisionShape, ...]
    points: np.ndarray
    radius_m: float
    spec: ObjectSpec
    fixed: bool
    inertia: Vector3


@lru_cache(maxsize=256)
def body_shape(object_name: str, geometry: Geometry, fixed: bool) -> BodyShape:
    """Prepare the body of an object; one without collision shapes counts as fixed."""
    spec = object_spec(object_name)
    corners = [
        np.c_[shape.points, np.full(len(shape.points), _margin(shape))] for shape in geometry.collision
    ]
    points = np.concatenate(corners) if corners else np.zeros((0, 4))
    reach = np.linalg.norm(points[:, :3], axis=1) + points[:, 3]
    return BodyShape(
        geometry.collision,
        points,
        float(reach.max(initial=0.0)),
        spec,
        fixed or not geometry.collision,
        _inertia(points, spec.mass_kg),
    )


def _margin(shape: CollisionShape) -> float:
    return BOX_MARGIN_M if isinstance(shape, CollisionBox) else HULL_MARGIN_M


def _inertia(points: np.ndarray, mass_kg: float) -> Vector3:
    """Moments of the solid bounding box of the collision shape, times VIMA-Bench's factor."""
    if not len(points):
        return (1e-6, 1e-6, 1e-6)
    growth = 2 * _INERTIA_GROWTH_M if points[:, 3].max() > BOX_MARGIN_M else 0.0
    x, y, z = np.square(np.ptp(points[:, :3], axis=0) + growth) * (_INERTIA_FACTOR * mass_kg / 12)
    return (float(y + z), float(x + z), float(x + y))


@lru_cache(maxsize=256)
def build_model(bodies: tuple[BodyShape, ...], *, with_spatula: bool) -> mujoco.MjModel:
    """Compile the model of some bodies.

    Body 0 is the world, the next ones are `bodies` in order, then probe and spatula. Free joints are in
    the same order, the spatula's last.
    """
    spec = mujoco.MjSpec()
    spec.memory = _MEMORY_BYTES
    spec.compiler.usethread = False  # a scene has a few small hulls: threads take longer to start
    spec.option.timestep = TICK_S
    spec.option.gravity = [0.0, 0.0, -GRAVITY_M_S2]
    spec.option.tolerance = 1e-10  # relative to the mean inertia before 4.0; the spatula dominates it
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # a pyramid biases friction towards its edges
    spec.option.impratio = 10.0  # friction as stiff as this against creeping
    floor = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [5.0, 5.0, 1.0], "pos": [0.0, 0.0, FLOOR_Z_M]}
    spec.worldbody.add_geom(**floor, **_contact(friction=1.0))
    assets: dict[str, bytes] = {}
    slippery: list[tuple[str, float, bool]] = []  # geom name, friction, whether the body is fixed
    for index, body in enumerate(bodies):
        slippery += _add_body(spec, index, body, assets)
    spec.assets = assets
    _add_slippery_pairs(spec, slippery)
    _add_probe(spec)
    if with_spatula:
        _add_spatula(spec)
    return spec.compile()


def _contact(
    friction: float, *, slippery: bool = False, affinity: int = _COLLIDES, margin: float = 0.0
) -> dict:
    return {
        "friction": [friction, 0.0, 0.0],
        "priority": int(slippery),
        **_SPRING,
        "margin": margin,
        "contype": _COLLIDES,
        "conaffinity": affinity,
    }


def _add_body(
    spec: mujoco.MjSpec, index: int, body: BodyShape, assets: dict[str, bytes]
) -> list[tuple[str, float, bool]]:
    added = spec.worldbody.add_body(name=f"body{index}")
    if body.fixed:
        added.mocap = True  # so that its pose is data too
    else:
        moment = sum(body.inertia) / 3
        added.add_joint(type=mujoco.mjtJoint.mjJNT_FREE, damping=[_TURNING_DAMPING_PER_S * moment] * 3)
        added.explicitinertial = True
        added.mass, added.inertia = body.spec.mass_kg, list(body.inertia)
        added.ipos, added.iquat = list(body.spec.com_offset), [1.0, 0.0, 0.0, 0.0]
    affinity = _COLLIDES if body.fixed else _COLLIDES | _COLLIDES_WITH_SPATULA
    friction = body.spec.friction
    names = []
    for part, shape in enumerate(body.shapes):
        name = f"body{index}/{part}"
        contact = _contact(friction, slippery=friction < 1, affinity=affinity, margin=_margin(shape))
        if isinstance(shape, CollisionBox):
            place = {
                "type": mujoco.mjtGeom.mjGEOM_BOX,
                "size": list(shape.half_size),
                "pos": list(shape.centre),
            }
        else:
            place = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": _add_hull(spec, shape.points, assets)}
        added.add_geom(name=name, **place, **contact)
        names.append(name)
    return [(name, friction, body.fixed) for name in names] if friction < 1 else []


def _add_hull(spec: mujoco.MjSpec, points: np.ndarray, assets: dict[str, bytes]) -> str:
    """Add the convex hull of points, as a file: MuJoCo caches the hulls of files."""
    header = np.array([len(points), 0, 0, 0], dtype=np.int32)  # vertices; no normals, texture points, faces
    content = header.tobytes() + points.astype(np.float32).tobytes()
    name = hashlib.sha1(content).hexdigest()
    file = f"{name}.msh"
    if file not in assets:
        assets[file] = content
        spec.add_mesh(name=name, file=file)
    return name


def _add_slippery_pairs(spec: mujoco.MjSpec, slippery: list[tuple[str, float, bool]]) -> None:
    for i, (name1, friction1, fixed1) in enumerate(slippery):
        for name2, friction2, fixed2 in slippery[:i]:
            if name1.split("/")[0] == name2.split("/")[0] or (fixed1 and fixed2):
                continue
            friction = friction1 * friction2
            spec.add_pair(
                geomname1=name1,
                geomname2=name2,
                friction=[friction, friction, 0.0, 0.0, 0.0],
                **_SPRING,
            )


def _add_probe(spec: mujoco.MjSpec) -> None:
    """A thin vertical cylinder without collisions, for distances to what is under the suction cup.

    Not a capsule: MuJoCo misses about half of all capsules that pierce a box.
    """
    body = spec.worldbody.add_body(name="probe", mocap=True, pos=[0.0, 0.0, PARKED_M])
    shape = {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [PROBE_RADIUS_M, PROBE_HALF_LENGTH_M, 0.0]}
    body.add_geom(name="probe", **shape, contype=0, conaffinity=0)


def _add_spatula(spec: mujoco.MjSpec) -> None:
    """A body with prescribed motion that pushes free bodies and passes through all others."""
    body = spec.worldbody.add_body(name="spatula", pos=[0.0, 0.0, PARKED_M], gravcomp=1.0)
    body.add_freejoint()
    body.explicitinertial = True
    body.mass, body.inertia = _SPATULA_MASS_KG, [_SPATULA_MASS_KG] * 3
    body.ipos, body.iquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    contact = _contact(1.0) | {"contype": _COLLIDES_WITH_SPATULA, "conaffinity": 0}
    box = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": list(SPATULA_HALF_SIZE_M)}
    body.add_geom(name="spatula", **box, **contact)
