"""The 31 objects of the benchmark: sizes, symmetries and physical properties, as frozen records.

Two of them (stand and disk of the towers of Hanoi) belong to no released task.

Source: the object list of VIMA-Bench; a few oddities are kept because published numbers depend on them.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

from openvima.catalog.geometry import Vector3
from openvima.errors import UnknownNameError, unknown_name

ObjectKind = Literal["kit", "box", "compound", "mesh", "registered"]
Profile = Literal["square", "circle"]

NO_SYMMETRY = 2 * math.pi
FULL_SYMMETRY = 0.0

# Bowl and frame: poses that the benchmark reads back are those of a centre of mass beside the link frame.
_SHIFTED_COM = (-0.01, 0.0, 0.02)


@dataclass(frozen=True, slots=True)
class ObjectSpec:
    """Catalogue record of one object.

    Args:
        name: Display name, by which everything refers to the object, such as "letter A".
        id: Identifier in upper case, such as "CAPITAL_LETTER_A".
        kind: "kit" (flat prism of fixed size, origin at its bottom), "box" (of the sampled size), "compound"
            (boxes placed from the sampled size), "mesh" (fixed size) or "registered" (a user's mesh, of
            the sampled size).
        size_min: Smallest nominal size (x, y, z) in metres. Sampling and spacing use it; the mesh may be
            smaller or larger.
        size_max: Largest nominal size; each axis is sampled uniformly in between.
        inertia_diag: Principal moments at the smallest size, kg m².
        symmetry_rad: Angle of rotational symmetry as the benchmark stores it: 2π none, 0 any angle, None
            unset. Stored and true values differ for block (true: π/2), cross (π/2) and triangle (2π); no
            task tests the rotation of these.
        profile: Outline that counts for "same profile"; None is a class of its own.
        mass_kg: Mass.
        friction: Coulomb friction against the table.
        rolling_friction: Coefficient of rolling resistance, metres.
        com_offset: Centre of mass in the link frame, metres.
        kit_scale: Scale s of a kit object: a nominal width of 0.08 s and a height of 0.02 s; None otherwise.
        aliases: Other names for paraphrased instructions; not valid names.
        novel_names: Further names that no task uses yet.
        container: Registered as something to put others into.
    """

    name: str
    id: str
    kind: ObjectKind
    size_min: Vector3
    size_max: Vector3
    inertia_diag: Vector3
    symmetry_rad: float | None = None
    profile: Profile | None = None
    mass_kg: float = 0.1
    friction: float = 1.0
    rolling_friction: float = 1e-4
    com_offset: Vector3 = (0.0, 0.0, 0.0)
    kit_scale: float | None = None
    aliases: tuple[str, ...] = ()
    novel_names: tuple[str, ...] = ()
    container: bool = False


def _fixed_size(
    name: str,
    kind: ObjectKind,
    size: Vector3,
    *,
    id: str = "",  # the field's name
    size_max: Vector3 | None = None,
    **properties: Any,  # fields of several types
) -> ObjectSpec:
    id = id or name.upper().replace(" ", "_").replace("-", "_")
    return ObjectSpec(name=name, id=id, kind=kind, size_min=size, size_max=size_max or size, **properties)


def _kit(
    name: str,
    scale: float,
    inertia_diag: Vector3,
    symmetry_rad: float | None,
    *,
    id: str = "",
    smallest_scale: float | None = None,
    profile: Profile | None = None,
    aliases: tuple[str, ...] = (),
) -> ObjectSpec:
    return ObjectSpec(
        name=name,
        id=id or name.upper().replace("LETTER", "CAPITAL_LETTER").replace(" ", "_"),
        kind="kit",
        size_min=_kit_size(smallest_scale or scale),
        size_max=_kit_size(scale),
        inertia_diag=inertia_diag,
        symmetry_rad=symmetry_rad,
        profile=profile,
        kit_scale=scale,
        aliases=aliases,
    )


def _kit_size(scale: float) -> Vector3:
    width = round(0.08 * scale, 6)
    return (width, width, round(0.02 * scale, 6))


_FIFTH = 2 * math.pi / 5

_SPECS = (
    _fixed_size(
        "bowl",
        "mesh",
        (0.17, 0.17, 0.0),
        symmetry_rad=FULL_SYMMETRY,
        profile="circle",
        rolling_friction=0.0,
        com_offset=_SHIFTED_COM,
        inertia_diag=(0.00126589, 0.00121442, 0.00227424),
    ),
    _fixed_size(
        "block",
        "box",
        (0.07, 0.07, 0.07),
        symmetry_rad=math.pi / 4,
        profile="square",
        mass_kg=0.01,
        inertia_diag=(2.45e-05, 2.45e-05, 2.45e-05),
        aliases=("cube",),
    ),
    _fixed_size(
        "shorter block",
        "box",
        (0.07, 0.07, 0.03),
        symmetry_rad=math.pi / 4,
        profile="square",
        mass_kg=0.01,
        inertia_diag=(1.45e-05, 1.45e-05, 2.45e-05),
        aliases=("cube",),
    ),
    _fixed_size(
        "pallet",
        "mesh",
        (0.21, 0.175, 0.035),
        profile="square",
        inertia_diag=(0.000845027, 0.0011924, 0.00198543),
    ),
    _fixed_size(
        "frame",
        "mesh",
        (0.225, 0.225, 0.0),
        profile="square",
        rolling_friction=0.0,
        com_offset=_SHIFTED_COM,
        inertia_diag=(0.000885856, 0.000885856, 0.0017672),
        novel_names=("zone",),
    ),
    _fixed_size(
        "container",
        "compound",
        (0.15, 0.15, 0.05),
        size_max=(0.17, 0.17, 0.05),
        profile="square",
        friction=0.3,
        inertia_diag=(0.000651596, 0.000651596, 0.0011858),
    ),
    _fixed_size(
        "three-sided rectangle",
        "compound",
        (0.2, 0.2, 0.0),
        rolling_friction=0.0,
        inertia_diag=(2e-07, 2e-07, 2e-07),
    ),
    _fixed_size(
        "small block",
        "box",
        (0.03, 0.03, 0.03),
        mass_kg=0.001,
        friction=0.5,
        inertia_diag=(4.5e-07, 4.5e-07, 4.5e-07),
    ),
    _fixed_size("line", "box", (0.25, 0.04, 0.001), rolling_friction=0.0, inertia_diag=(2e-07, 2e-07, 2e-07)),
    _fixed_size(
        "square",
        "compound",
        (0.2, 0.04, 0.001),
        profile="square",
        rolling_friction=0.0,
        inertia_diag=(4.45e-05, 0.0010205, 0.0010642),
    ),
    _kit("letter A", 1.8, (0.000331875, 0.000266868, 0.000523753), NO_SYMMETRY),
    _kit("letter E", 1.8, (0.000329828, 0.000138367, 0.000393205), NO_SYMMETRY),
    _kit("letter G", 1.8, (0.000344189, 0.000229597, 0.000498796), NO_SYMMETRY),
    _kit("letter M", 1.7, (0.000296516, 0.000273078, 0.00050148), NO_SYMMETRY),
    _kit("letter R", 1.8, (0.000329828, 0.000193211, 0.000448048), NO_SYMMETRY),
    _kit("letter T", 1.8, (0.000362395, 0.000362395, 0.0006498), NO_SYMMETRY),
    _kit("letter V", 1.8, (0.000329828, 0.00024237, 0.000497208), NO_SYMMETRY),
    _kit("cross", 1.6, (0.000290884, 0.000290884, 0.0005202), math.pi),
    _kit("diamond", 1.6, (0.000290884, 0.000427684, 0.000657), math.pi),
    _kit("triangle", 1.6, (0.000290884, 0.000290884, 0.0005202), 2 * math.pi / 3),
    _kit("flower", 1.8, (0.000362395, 0.000362395, 0.0006498), math.pi / 2),
    _kit("heart", 1.8, (0.000292504, 0.000336936, 0.00055445), NO_SYMMETRY),
    _kit("hexagon", 1.8, (0.000362395, 0.000285141, 0.000572546), math.pi / 3, smallest_scale=1.6),
    _kit("pentagon", 1.8, (0.000307207, 0.000333972, 0.000565986), _FIFTH, smallest_scale=1.6),
    _kit(
        "L-shaped block",
        1.6,
        (0.000290884, 0.000290884, 0.0005202),
        NO_SYMMETRY,
        id="L_BLOCK",
        aliases=("L-shape",),
    ),
    _kit("ring", 1.6, (0.000290884, 0.000290884, 0.0005202), FULL_SYMMETRY, profile="circle"),
    _kit("round", 1.6, (0.000290884, 0.000290884, 0.0005202), None, profile="circle"),
    _kit("star", 1.8, (0.000367587, 0.000337646, 0.000630242), _FIFTH, smallest_scale=1.6),
    _fixed_size(
        "pan",
        "mesh",
        (0.16, 0.24, 0.03),
        symmetry_rad=FULL_SYMMETRY,
        profile="circle",
        inertia_diag=(0.000817844, 0.00229857, 0.00300472),
    ),
    _fixed_size(
        "stand",
        "compound",
        (0.18, 0.54, 0.01),
        id="HANOI_STAND",
        friction=0.5,
        inertia_diag=(0.0042184, 0.0014365, 0.0044381),
    ),
    _fixed_size(
        "disk",
        "mesh",
        (0.18, 0.18, 0.035),
        id="HANOI_DISK",
        profile="circle",
        inertia_diag=(0.0002628, 0.0002628, 0.0004608),
    ),
)

OBJECTS: dict[str, ObjectSpec] = {spec.name: spec for spec in _SPECS}
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
    try:
        return OBJECTS.get(name) or REGISTERED_OBJECTS[name]
    except (KeyError, TypeError):
        hint = (
            "`openvima.catalog.OBJECTS` holds the 31 built-in ones; your own need `register_object`, in "
            "a file of OPENVIMA_TASK_FILES or for --assets."
        )
        known = (*OBJECTS, *REGISTERED_OBJECTS)
        raise UnknownNameError(unknown_name("object", name, known, hint)) from None
