"""The table of objects: own invariants, and equality with the machine-readable catalogue."""

import math

import pytest

from openvima.catalog.objects import OBJECTS, object_spec
from openvima.errors import UnknownObjectError


def test_there_are_31_objects_with_distinct_names_and_ids():
    assert len(OBJECTS) == 31
    assert len({spec.id for spec in OBJECTS.values()}) == 31
    assert all(name == spec.name for name, spec in OBJECTS.items())


def test_sizes_are_ordered_and_masses_positive():
    for spec in OBJECTS.values():
        assert all(0 <= low <= high < 1 for low, high in zip(spec.size_min, spec.size_max, strict=True))
        assert spec.mass_kg > 0 and spec.friction > 0 and min(spec.inertia_diag) > 0


def test_nine_objects_have_no_rotational_symmetry():
    names = {spec.name for spec in OBJECTS.values() if spec.symmetry_rad == 2 * math.pi}
    letters = {f"letter {letter}" for letter in "AEGMRTV"}
    assert names == letters | {"heart", "L-shaped block"}


def test_an_unknown_object_is_refused_with_the_nearest_name():
    with pytest.raises(UnknownObjectError, match="Did you mean 'letter A'"):
        object_spec("leter A")


def test_objects_equal_the_machine_readable_catalogue(catalogue):
    assert [spec.name for spec in OBJECTS.values()] == [record["name"] for record in catalogue["objects"]]
    for record in catalogue["objects"]:
        spec = OBJECTS[record["name"]]
        assert spec.id == record["id"]
        assert spec.kind == record["kind"]
        assert spec.profile == record["profile"]
        assert list(spec.aliases) == record["aliases"]
        assert list(spec.novel_names) == record["novel_names"]
        assert spec.kit_scale == record.get("kit_s")
        assert (spec.symmetry_rad is None) == (record["symmetry_rad"] is None)
        if spec.symmetry_rad is not None:
            assert spec.symmetry_rad == pytest.approx(record["symmetry_rad"], abs=1e-8)
        for ours, theirs in (
            (spec.size_min, "size_min"),
            (spec.size_max, "size_max"),
            (spec.mass_kg, "mass"),
            (spec.friction, "lateral_friction"),
            (spec.rolling_friction, "rolling_friction"),
            (spec.com_offset, "com_offset"),
            (spec.inertia_diag, "inertia_diag"),
        ):
            value = list(ours) if isinstance(ours, tuple) else ours
            assert value == record[theirs], (spec.name, theirs)
