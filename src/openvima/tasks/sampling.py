"""Sampling of episodes: free places on the table, sizes, and new draws after bad luck."""

import functools
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from openvima.catalog import Assets, Pool, Vector3, object_spec
from openvima.errors import ConfigError, SamplingError, unknown_name
from openvima.scene import (
    FIRST_OBJECT_ID,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    EndEffector,
    Episode,
    Placement,
    Pose,
    Scene,
)
from openvima.tasks.ids import shuffled_ids
from openvima.tasks.registry import TaskSpec, task_spec
from openvima.tasks.seeding import checked_seed, stream

T = TypeVar("T")

CELL_M = 0.003125  # side of a raster cell; the benchmark's resolution for placing and picking
MAX_REDRAWS = 100
HOLLOW_OBJECTS = ("frame", "square")  # bases whose inside looks free from above
_HOLLOW_MARGIN_M = 0.01
_FOOTPRINT_TRIES = 20


def sample_episode(
    task: str,
    *,
    level: str = "train",
    seed: int,
    domain: str = "user",
    assets: "str | Assets" = "procedural",
    compat: bool = False,
    **options: object,
) -> Episode:
    """Sample one episode of a task.

    Args:
        task: Name of the task.
        level: "train" or "L1" to "L4".
        seed: The episode's number, 0 … 2⁶³ − 1.
        domain: "train", "eval" or "user"; equal seeds of two domains give unrelated episodes.
        assets: Asset pack: "procedural", a folder with the original pack, or a pack already loaded.
        compat: Sample as the original benchmark does: objects hover at the start, ids follow the order of
            placing, and starts that overlap or are decided already are accepted.
        **options: The task's own options, as `task_spec(task).options` lists them.

    Returns:
        The episode; equal arguments give an equal one on every machine.

    Raises:
        UnknownTaskError: There is no such task.
        LevelError: There is no such level, or the task is not defined there.
        ConfigError: The seed, the domain or an option is not allowed.
        SamplingError: No draw in a hundred could place all objects.

    Example:
        >>> sample_episode("rotate", seed=7).problem.scene.end_effector
        'suction'
    """
    from openvima.catalog.packs import load_assets

    spec = task_spec(task)
    pool, number = spec.pool(level), checked_seed(seed)
    _check_options(spec, options)
    pack = load_assets(assets)
    reason = SamplingError()
    for attempt in range(MAX_REDRAWS + 1):
        rng = stream(domain, task, level, number, "scene", attempt=attempt)
        table = TableSampler(rng, pool, assets=pack, end_effector=spec.end_effector, compat=compat)
        try:
            problem = spec.sample(table, **options)
        except SamplingError as error:
            reason = error
            continue
        if not compat:
            problem = shuffled_ids(problem, stream(domain, task, level, number, "ids", attempt=attempt))
        return Episode(
            task, level, domain, number, problem, spec.oracle_max_steps, spec.max_steps, num_redraws=attempt
        )
    raise SamplingError(
        f"{MAX_REDRAWS + 1} draws of {task} at level {level}, seed {number}, failed: {reason}"
    )


def _check_options(spec: TaskSpec, options: dict[str, object]) -> None:
    for name in options:
        if name not in spec.options:
            raise ConfigError(unknown_name(f"option of task {spec.name!r}:", name, spec.options))


class TableSampler:
    """A table being laid: draws objects and places from one generator and remembers what stands where.

    Objects of the pool's base list are fixed, all others can be moved.

    Args:
        rng: Every draw comes from here.
        pool: What the task may draw from.
        assets: Where shapes come from.
        end_effector: Tool of the arm; it decides the first object's id.
        compat: Sample as the original benchmark does.
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
        from openvima.render.labels import empty_labels  # compiled code: not for a mere list of tasks

        self.rng = rng
        self.pool = pool
        self.compat = compat
        self.placements: list[Placement] = []
        self._assets = assets
        self._end_effector: EndEffector = end_effector
        self._labels, self._heights = empty_labels()

    def choose(self, options: Sequence[T]) -> T:
        """Draw one of several things with equal probability."""
        return options[int(self.rng.integers(len(options)))]

    def sample_size(self, object_name: str) -> Vector3:
        """Draw a nominal size in metres, each axis on its own."""
        spec = object_spec(object_name)
        x, y, z = self.rng.uniform(spec.size_min, spec.size_max).tolist()
        return (x, y, z)

    def place(
        self,
        what: str,
        draw: Callable[[], tuple[str, str]],
        *,
        count: int = 1,
        tries: int = 10,
        apart_m: float = 0.0,
    ) -> list[Placement]:
        """Put objects on free places of the table, at any heading.

        Args:
            what: Role of the objects, for the message of an error.
            draw: Draws an object's name and texture, anew in each try.
            count: How many objects to place.
            tries: Tries for all of them together.
            apart_m: Keep the link frames this far from those of all other objects; not with `compat`.

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
            size = self.sample_size(object_name)
            pose = self.free_pose(object_name, size)
            if pose is None or self._is_crowded(object_name, size, pose, apart_m):
                continue
            placed.append(self.add(object_name, texture, size=size, pose=pose))
        if len(placed) < count:
            raise SamplingError(f"only {len(placed)} of {count} × {what} found a place in {tries} tries.")
        return placed

    def place_one(
        self, what: str, draw: Callable[[], tuple[str, str]], *, tries: int = 10, apart_m: float = 0.0
    ) -> Placement:
        """Put one object on a free place; see `place`."""
        return self.place(what, draw, tries=tries, apart_m=apart_m)[0]

    def add(
        self, object_name: str, texture: str, *, size: Vector3, pose: Pose, fixed: bool | None = None
    ) -> Placement:
        """Put an object at a given pose.

        Args:
            object_name: Display name in the catalogue.
            texture: Display name in the catalogue.
            size: Nominal size in metres.
            pose: Where it goes; its height becomes that of rest (with `compat`: half the nominal height).
            fixed: Whether it is welded to the table; by default if the pool lists it as a base.

        Returns:
            The object.
        """
        z = size[2] / 2 if self.compat else self._assets.geometry(object_name, size).rest_z_m
        placement = Placement(
            id=FIRST_OBJECT_ID[self._end_effector] + len(self.placements),
            object=object_name,
            texture=texture,
            size=size,
            pose=Pose((pose.x, pose.y, z), pose.quaternion),
            fixed=object_name in self.pool.base_objects if fixed is None else fixed,
        )
        self._stamp(self._labels, self._heights, placement)
        self.placements.append(placement)
        return placement

    def free_pose(self, object_name: str, size: Vector3) -> Pose | None:
        """Draw a place whose surroundings are free, and a heading.

        A square window around the place, as wide as the diagonal of the nominal footprint, holds no object
        and stays clear of the table's edge. What is drawn of some bases is larger than their nominal
        footprint; for these the cells that they would cover must be free as well (not with `compat`).

        Args:
            object_name: Display name in the catalogue.
            size: Nominal size in metres.

        Returns:
            The pose, its height 0, or None if no place is left.
        """
        from openvima.tasks.kernels import mark_free_centres, nth_centre

        side = round(float(np.hypot(size[0], size[1])) / CELL_M)
        centres = np.empty(self._labels.shape, np.uint8)
        counts, run = np.empty(len(centres), np.int32), np.empty(len(centres.T), np.int32)
        num_free = mark_free_centres(self._labels, side, run, centres, counts)
        if num_free == 0:
            return None
        is_larger = not self.compat and _reach_m(self._assets, object_name, size) > (side / 2 + 1) * CELL_M
        for _ in range(_FOOTPRINT_TRIES if is_larger else 1):
            row, column = nth_centre(centres, counts, int(self.rng.integers(num_free)))
            pose = Pose.planar(
                WORKSPACE_LOW[0] + column * CELL_M,
                WORKSPACE_LOW[1] + row * CELL_M,
                self.rng.uniform(0.0, 2 * np.pi),
            )
            if not is_larger or self._footprint_is_free(object_name, size, pose):
                return pose
        return None

    def scene(self) -> Scene:
        """Return everything placed so far."""
        return Scene(tuple(self.placements), self._end_effector)

    def _stamp(self, labels: np.ndarray, heights: np.ndarray, placement: Placement) -> None:
        from openvima.render.labels import stamp

        stamp(labels, heights, placement, self._assets)

    def _footprint_is_free(self, object_name: str, size: Vector3, pose: Pose) -> bool:
        geometry = self._assets.geometry(object_name, size)
        corners = pose.transform(geometry.visual.vertices.reshape(-1, 3))[:, :2]
        if (corners < WORKSPACE_LOW).any() or (corners > WORKSPACE_HIGH).any():
            return False
        if not self.placements:
            return True
        labels, heights = np.zeros_like(self._labels), np.zeros_like(self._heights)
        raised = Pose((pose.x, pose.y, max(geometry.rest_z_m, 0.0)), pose.quaternion)
        self._stamp(labels, heights, Placement(1, object_name, "", size, raised))
        return not self._labels[labels > 0].any()

    def _is_crowded(self, object_name: str, size: Vector3, pose: Pose, apart_m: float) -> bool:
        new = Placement(0, object_name, "", size, pose, fixed=object_name in self.pool.base_objects)
        for other in self.placements:
            if not self.compat and pose.planar_distance(other.pose) < apart_m:
                return True
            base, movable = (new, other) if new.fixed else (other, new)
            if base.fixed and not movable.fixed and is_in_hollow(movable, base):
                return True
        return False


def is_in_hollow(placement: Placement, base: Placement) -> bool:
    """Whether an object counts as inside a frame or a square, whose inside looks free from above.

    Args:
        placement: The object; its nominal size and its place count.
        base: The base; only frame and square are hollow.
    """
    if base.object not in HOLLOW_OBJECTS:
        return False
    reach = max((placement.size[axis] + base.size[axis]) / 2 + _HOLLOW_MARGIN_M for axis in (0, 1))
    return placement.pose.planar_distance(base.pose) <= reach


@functools.lru_cache(maxsize=1024)
def _reach_m(assets: Assets, object_name: str, size: Vector3) -> float:
    """Largest planar distance of anything drawn of an object from its link frame, in metres."""
    vertices = assets.geometry(object_name, size).visual.vertices
    return float(np.hypot(vertices[..., 0], vertices[..., 1]).max())
