"""Sampling of object placements on the table."""

import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from openvima.catalog import Assets, Pool, Vector3, object_spec
from openvima.catalog.geometry import CollisionShape
from openvima.errors import SamplingError
from openvima.scene import (
    FIRST_OBJECT_ID,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    EndEffector,
    Placement,
    Point,
    Pose,
    Scene,
)

_NUM_STEPS = 1000  # the error falls as one over this number


T = TypeVar("T")
Appearance = tuple[str, str]  # names of object and texture
Draw = Callable[[], Appearance]
Reject = Callable[[Placement], bool]

CELL_M = 0.003125  # side of a raster cell; the benchmark's resolution for placing and picking
NO_SCALE = (1.0, 1.0, 1.0)
HOLLOW_OBJECTS = ("frame", "square")  # bases whose inside counts as free
_CROWDING_MARGIN_M = 0.01
_FOOTPRINT_TRIES = 20


def never(placement: Placement) -> bool:
    """Accept every placement: the default of `reject`."""
    return False


class TableSampler:
    """Samples objects and their placements with one generator.

    Objects of the pool's base list are fixed, all others are movable.

    Args:
        rng: Generator of all draws.
        pool: Objects and textures of the task at its level.
        assets: Asset pack.
        end_effector: Tool of the arm; determines the first object's id.
        compat: Sample as VIMA-Bench does.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        pool: Pool,
        *,
        assets: Assets,
        end_effector: EndEffector = "suction",
        compat: bool = False,
    ) -> None:
        self.rng = rng
        self.pool = pool
        self.compat = compat
        self.placements: list[Placement] = []
        self.assets = assets
        self._end_effector: EndEffector = end_effector
        self._labels, self._heights = self._stamped(())

    def appearances(self) -> list[Appearance]:
        """All shapes and textures of dragged objects of the pool."""
        return list(itertools.product(self.pool.dragged_objects, self.pool.dragged_textures))

    def choose(self, options: Sequence[T]) -> T:
        """Draw one option uniformly."""
        return options[int(self.rng.integers(len(options)))]

    def shuffled(self, options: Sequence[T]) -> list[T]:
        """Return the options in random order."""
        return [options[index] for index in self.rng.permutation(len(options)).tolist()]

    def distinct(self, options: Sequence[T], count: int) -> list[T]:
        """Draw so many different options."""
        return [options[index] for index in self.rng.choice(len(options), count, replace=False).tolist()]

    def drawing(self, objects: Sequence[str], textures: Sequence[str]) -> Draw:
        """Return a function that draws an object and its texture, for `place`."""
        return lambda: (self.choose(objects), self.choose(textures))

    def sample_size(self, object_name: str) -> Vector3:
        """Draw a nominal size in metres: each axis independently, of registered objects all by one factor."""
        spec = object_spec(object_name)
        if spec.kind == "registered":  # keeps its proportions
            least, most = np.array(spec.size_min), np.array(spec.size_max)
            x, y, z = (least + self.rng.random() * (most - least)).tolist()
            return (x, y, z)
        x, y, z = self.rng.uniform(spec.size_min, spec.size_max).tolist()
        return (x, y, z)

    def place(
        self,
        what: str,
        draw: Draw,
        *,
        count: int = 1,
        tries: int = 10,
        size: Vector3 | None = None,
        scale: Vector3 = NO_SCALE,
        apart_m: float = 0.0,
        reject: Reject = never,
    ) -> list[Placement]:
        """Place objects at random free poses.

        Args:
            what: Role of the objects, for the message of an error.
            draw: Draws the name and texture of an object in each try.
            count: Number of objects.
            tries: Tries for all of them together.
            size: Nominal size in metres; by default drawn for each object.
            scale: Factor per axis on top of the size.
            apart_m: Smallest distance to the link frames of other objects; ignored with `compat`.
            reject: Whether to reject a placement.

        Returns:
            The objects placed.

        Raises:
            SamplingError: The tries were used up.
        """
        placed: list[Placement] = []
        for _ in range(tries):
            if len(placed) == count:
                break
            object_name, texture = draw()
            drawn_size = size or self.sample_size(object_name)
            pose = self.free_pose(object_name, drawn_size)
            if pose is None:
                continue
            new = self._at_rest(object_name, texture, drawn_size, pose, scale)
            if not self._is_crowded(new, apart_m) and not reject(new):
                placed.append(self._put(new))
        if len(placed) < count:
            raise SamplingError(f"only {len(placed)} of {count} × {what} found a place in {tries} tries.")
        return placed

    def place_one(self, what: str, draw: Draw, **settings: Any) -> Placement:
        """Place one object, with the settings of `place`."""
        return self.place(what, draw, **settings)[0]

    def find_place(
        self,
        what: str,
        placement: Placement,
        *,
        tries: int = 10,
        apart_m: float = 0.0,
        reject: Reject = never,
    ) -> Placement:
        """Sample another free pose of an object without moving it; its current place is not free.

        Args:
            what: Role of the object, for the message of an error.
            placement: The object.
            tries: Number of tries.
            apart_m: As for `place`.
            reject: As for `place`.

        Returns:
            The object at the new pose.

        Raises:
            SamplingError: The tries were used up.
        """
        for _ in range(tries):
            pose = self.free_pose(placement.object, placement.size)
            found = pose and placement.at(Pose((pose.x, pose.y, placement.pose.z), pose.quaternion))
            if found is not None and not self._is_crowded(found, apart_m) and not reject(found):
                return found
        raise SamplingError(f"{what} found no other place in {tries} tries.")

    def move(self, placement: Placement, place: Placement) -> Placement:
        """Move an object to a pose from `find_place`; return it there."""
        self.placements[self.placements.index(placement)] = place
        self._labels, self._heights = self._stamped(self.placements)
        return place

    def add(
        self,
        object_name: str,
        texture: str,
        *,
        pose: Pose,
        size: Vector3 | None = None,
        fixed: bool | None = None,
        scale: Vector3 = NO_SCALE,
        z: float | None = None,
        on_top: bool = False,
    ) -> Placement:
        """Place an object at a given pose.

        Args:
            object_name: Display name in the catalogue.
            texture: Display name in the catalogue.
            pose: Its pose; the height is ignored.
            size: Nominal size in metres; by default drawn.
            fixed: Whether it is fixed to the table; by default if it is a base of the pool.
            scale: Factor per axis on top of the size.
            z: Height of its link frame in metres; by default that of rest on the table (with `compat`: half
                the nominal height).
            on_top: Place it on top of the objects below instead of on the table.

        Returns:
            The object.
        """
        size = size or self.sample_size(object_name)
        new = self._at_rest(object_name, texture, size, pose, scale, fixed)
        if on_top:
            height_m = float(self._heights[self.covered(new)].max(initial=0.0))  # of what is below
            new = new.at(new.pose.moved(dz=height_m)) if height_m else new
        return self._put(new if z is None else new.at(Pose((pose.x, pose.y, z), pose.quaternion)))

    def centred_in(self, base: Placement, object_name: str, size: Vector3) -> Pose:
        """Return the unrotated pose of an object that rests level in a round base.

        The smallest enclosing circles of their meshes are concentric, so the object touches the slope at
        equal heights.

        Args:
            base: The base, unrotated.
            object_name: Display name in the catalogue.
            size: Nominal size in metres.
        """
        base_x, base_y = _circle_centre_m(self.assets, base.object, base.size)
        x, y = _circle_centre_m(self.assets, object_name, size)
        return Pose.planar(base.pose.x + base_x - x, base.pose.y + base_y - y)

    def blank(self) -> "TableSampler":
        """Return an empty sampler for a prompt scene with the same generator; nothing is fixed."""
        pool = replace(self.pool, base_objects=())
        return TableSampler(
            self.rng, pool, assets=self.assets, end_effector=self._end_effector, compat=self.compat
        )

    def free_pose(self, object_name: str, size: Vector3) -> Pose | None:
        """Draw a free position and a heading.

        A square window around the position, as wide as the diagonal of the nominal footprint, contains no
        object and not the table's edge. Some bases are larger than their nominal footprint; the cells that
        they cover must be free as well (not with `compat`).

        Args:
            object_name: Display name in the catalogue.
            size: Nominal size in metres.

        Returns:
            The pose at height 0, or None without a free position.
        """
        from openvima.tasks.kernels import list_free_centres

        side = round(float(np.hypot(size[0], size[1])) / CELL_M)
        num_columns = self._labels.shape[1]
        run, centres = np.empty(num_columns, np.int32), np.empty(self._labels.size, np.int32)
        num_free = list_free_centres(self._labels, side, run, centres)
        if num_free == 0:
            return None
        is_larger = not self.compat and _reach_m(self.assets, object_name, size) > (side / 2 + 1) * CELL_M
        for _ in range(_FOOTPRINT_TRIES if is_larger else 1):
            row, column = divmod(int(centres[self.rng.integers(num_free)]), num_columns)
            pose = Pose.planar(
                WORKSPACE_LOW[0] + column * CELL_M,
                WORKSPACE_LOW[1] + row * CELL_M,
                self.rng.uniform(0.0, 2 * np.pi),
            )
            if not is_larger or self._footprint_is_free(object_name, size, pose):
                return pose
        return None

    def covered(self, placement: Placement) -> np.ndarray:
        """Return the cells that an object covers from above, whatever its height; shape (320, 160), bool."""
        geometry = placement.geometry(self.assets)
        pose = placement.pose
        raised = Pose((pose.x, pose.y, max(geometry.rest_z_m, 0.0)), pose.quaternion)
        return self._stamped([replace(placement, id=1, pose=raised)])[0] > 0

    def scene(self) -> Scene:
        """Return the scene placed so far."""
        return Scene(tuple(self.placements), self._end_effector)

    def _at_rest(
        self,
        object_name: str,
        texture: str,
        size: Vector3,
        pose: Pose,
        scale: Vector3,
        fixed: bool | None = None,
    ) -> Placement:
        hover_z = size[2] * scale[2] / 2
        z = hover_z if self.compat else self.assets.geometry(object_name, size, scale).rest_z_m
        return Placement(
            id=FIRST_OBJECT_ID[self._end_effector] + len(self.placements),
            object=object_name,
            texture=texture,
            size=size,
            pose=Pose((pose.x, pose.y, z), pose.quaternion),
            fixed=object_name in self.pool.base_objects if fixed is None else fixed,
            scale=scale,
        )

    def _put(self, placement: Placement) -> Placement:
        self._stamped([placement], onto=(self._labels, self._heights))
        self.placements.append(placement)
        return placement

    def _stamped(
        self, placements: Sequence[Placement], *, onto: tuple[np.ndarray, np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Labels and heights of these objects, on an empty table or on what is given, which changes."""
        from openvima.render.labels import empty_labels, stamp  # Numba, which a list of tasks does not need

        labels, heights = onto or empty_labels()
        for placement in placements:
            stamp(labels, heights, placement, self.assets)
        return labels, heights

    def _footprint_is_free(self, object_name: str, size: Vector3, pose: Pose) -> bool:
        geometry = self.assets.geometry(object_name, size)
        corners = pose.transform(geometry.visual.vertices.reshape(-1, 3))[:, :2]
        if (corners < WORKSPACE_LOW).any() or (corners > WORKSPACE_HIGH).any():
            return False
        if not self.placements:
            return True
        return not self._labels[self.covered(Placement(1, object_name, "", size, pose))].any()

    def _is_crowded(self, new: Placement, apart_m: float) -> bool:
        for other in self.placements:
            if other.id == new.id:
                continue
            if not self.compat and new.pose.planar_distance(other.pose) < apart_m:
                return True
            base, movable = (new, other) if new.fixed else (other, new)
            if base.fixed and not movable.fixed and is_in_hollow(movable, base):
                return True
        return False


def grid_point(row: float, num_rows: int, column: float, num_columns: int) -> Pose:
    """Return the pose at a fraction of the table's width and length, from its lower corner, unrotated."""
    (low_x, low_y), (high_x, high_y) = WORKSPACE_LOW, WORKSPACE_HIGH
    x = low_x + row * (high_x - low_x) / num_rows
    return Pose.planar(x, low_y + column * (high_y - low_y) / num_columns)


def is_in_hollow(placement: Placement, base: Placement) -> bool:
    """Whether an object counts as inside a frame or a square.

    Args:
        placement: The object.
        base: The base; only frame and square are hollow.
    """
    return base.object in HOLLOW_OBJECTS and is_in_the_way(placement, base)


def is_in_the_way(placement: Placement, other: Placement, apart_m: float = 0.0) -> bool:
    """Whether two objects crowd each other, by nominal size and position alone, or are nearer than `apart_m`.

    Source: VIMA-Bench; its square windows ignore the headings.
    """
    reach = max((placement.size[axis] + other.size[axis]) / 2 + _CROWDING_MARGIN_M for axis in (0, 1))
    distance = placement.pose.planar_distance(other.pose)
    return distance <= reach or distance < apart_m


def offset(placement: Placement, other: Placement, direction: tuple[float, float]) -> tuple[float, float]:
    """Return how far an object is from another along and across a direction in x and y, times its length."""
    dx, dy = placement.pose.x - other.pose.x, placement.pose.y - other.pose.y
    return dx * direction[0] + dy * direction[1], abs(dx * direction[1] - dy * direction[0])


_ON_TABLE_M = 0.003  # above its height at rest
_ANGLES = np.arange(64) * (np.pi / 64)
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])  # in which a line may part two convex shapes


def is_wedged(placement: Placement, base: Placement, assets: Assets) -> bool:
    """Whether an object that lies on the table reaches into the convex collision shapes of a base.

    A top view does not show it: the hull of a pan fills the corners beside its handle, and what lies there
    would be pressed into the table.
    """
    geometry = placement.geometry(assets)
    if placement.pose.z > geometry.rest_z_m + _ON_TABLE_M:
        return False
    shadows = [_shadow(part, placement.pose) for part in geometry.collision]
    others = [_shadow(part, base.pose) for part in base.geometry(assets).collision]
    return any(
        not ((low > other_high) | (other_low > high)).any()
        for low, high in shadows
        for other_low, other_high in others
    )


def _shadow(part: CollisionShape, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest coordinates of a convex part on the table along all directions, shape (64,), m."""
    along = pose.transform(part.points)[:, :2] @ _DIRECTIONS
    return along.min(axis=0), along.max(axis=0)


@functools.lru_cache(maxsize=256)
def _reach_m(assets: Assets, object_name: str, size: Vector3) -> float:
    """Largest planar distance of an object's mesh from its link frame, in metres."""
    vertices = assets.geometry(object_name, size).visual.vertices
    return float(np.hypot(vertices[..., 0], vertices[..., 1]).max())


@functools.lru_cache(maxsize=256)
def _circle_centre_m(assets: Assets, object_name: str, size: Vector3) -> Point:
    """Centre of the smallest circle around an object's mesh, in its link frame, in metres.

    It is accurate to about a thousandth of the radius.

    Source: Bădoiu and Clarkson, "Smaller core-sets for balls" (2003): shrinking steps towards the
    farthest point.
    """
    vertices = assets.geometry(object_name, size).visual.vertices
    points = np.unique(vertices.reshape(-1, 3)[:, :2], axis=0)
    centre = points[0]
    for step in range(2, _NUM_STEPS):
        away = points - centre
        farthest = int(np.argmax(away[:, 0] ** 2 + away[:, 1] ** 2))
        centre = centre + away[farthest] / step
    x, y = centre.tolist()
    return x, y
