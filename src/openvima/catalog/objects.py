"""The 31 objects of the benchmark, from `objects.json`: sizes, symmetries and physical properties.

Two of them (stand and disk of the towers of Hanoi) belong to no released task.

Source: the object list of VIMA-Bench; a few oddities are kept because published numbers depend on them.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from openvima.catalog.geometry import Vector3
from openvima.catalog.records import find_record, read_records

ObjectKind = Literal["kit", "box", "compound", "mesh", "registered"]
Profile = Literal["square", "circle"]

NO_SYMMETRY = 2 * math.pi
FULL_SYMMETRY = 0.0


@dataclass(frozen=True, slots=True)
class ObjectSpec:
    """Catalogue record of one object.

    Args:
        name: Display name, by which everything refers to the object, such as "letter A".
        kind: "kit" (flat prism of fixed size, origin at its bottom), "box" (of the sampled size), "compound"
            (boxes placed from the sampled size), "mesh" (fixed size) or "registered" (a user's mesh, of
            the sampled size).
        size_min: Smallest nominal size (x, y, z) in metres. Sampling and spacing use it; the mesh may be
            smaller or larger.
        size_max: Largest nominal size; each axis is sampled uniformly in between.
        symmetry_rad: Angle of rotational symmetry as the benchmark stores it: 2π none, 0 any angle, None
            unset. Stored and true values differ for block (true: π/2), cross (π/2) and triangle (2π); no
            task tests the rotation of these.
        profile: Outline that counts for "same profile"; None is a class of its own.
        mass_kg: Mass.
        friction: Coulomb friction against the table.
        com_offset: Centre of mass in the link frame, metres. Those of bowl and frame are beside it, since
            the benchmark reads back their poses.
        kit_scale: Scale s of a kit object: a nominal width of 0.08 s and a height of 0.02 s; None otherwise.
        aliases: Other names for paraphrased instructions; not valid names.
        original_file: Where the original pack keeps the mesh; empty for boxes.
    """

    name: str
    kind: ObjectKind
    size_min: Vector3
    size_max: Vector3
    symmetry_rad: float | None = None
    profile: Profile | None = None
    mass_kg: float = 0.1
    friction: float = 1.0
    com_offset: Vector3 = (0.0, 0.0, 0.0)
    kit_scale: float | None = None
    aliases: tuple[str, ...] = ()
    original_file: str = ""


OBJECTS: dict[str, ObjectSpec] = {
    record["name"]: ObjectSpec(**record) for record in read_records(Path(__file__).with_suffix(".json"))
}
"""All objects by display name, in the benchmark's order."""


REGISTERED_OBJECTS: dict[str, ObjectSpec] = {}
"""Objects of users by display name, from `register_object`."""


def object_spec(name: str) -> ObjectSpec:
    """Return the record of an object.

    Args:
        name: Display name, case-sensitive, such as "L-shaped block".

    Raises:
        UnknownNameError: There is no such object; the message suggests the nearest name.

    Example:
        >>> object_spec("block").size_max
        (0.07, 0.07, 0.07)
    """
    return find_record("object", name, OBJECTS, REGISTERED_OBJECTS)
