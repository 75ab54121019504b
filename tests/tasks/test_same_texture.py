"""Scenes and prompts of `same_texture` follow their specification; `test_gathering.py` judges outcomes."""

import pytest

from openvima.catalog import TEXTURE_SETS
from openvima.catalog.objects import OBJECTS
from openvima.scene import Placement
from openvima.tasks import sample_episode, task_spec
from task_cases import assert_uniform, group_roles

BASES = ("pan", "bowl", "container", "frame", "pallet", "square")
KIT = tuple(name for name, spec in OBJECTS.items() if spec.kind == "kit")

Roles = tuple[Placement, list[Placement], list[Placement]]


@pytest.fixture(scope="module")
def all_roles() -> list[Roles]:
    return [
        group_roles(sample_episode("same_texture", level="L4", seed=seed).problem) for seed in range(1000)
    ]


@pytest.mark.slow
def test_bases_and_textures_are_uniform(all_roles: list[Roles]) -> None:
    assert len(TEXTURE_SETS["T_first"]) == 24 and len(TEXTURE_SETS["T_second"]) == 25
    assert_uniform([base.object for base, _, _ in all_roles], BASES)
    assert_uniform([base.texture for base, _, _ in all_roles], TEXTURE_SETS["T_second"])
    assert_uniform(
        [d.texture for _, _, distractors in all_roles for d in distractors], TEXTURE_SETS["T_first"]
    )


def test_the_objects_to_gather_have_the_bases_texture_and_distractors_another(all_roles: list[Roles]) -> None:
    for base, dragged, distractors in all_roles:
        assert {p.texture for p in dragged} == {base.texture}
        assert base.texture not in {p.texture for p in distractors}


def test_shapes_are_the_19_of_the_task_nearly_equally_often(all_roles: list[Roles]) -> None:
    assert len(KIT) == 18
    for shapes in (
        [p.object for _, dragged, _ in all_roles for p in dragged],
        [p.object for _, _, distractors in all_roles for p in distractors],
    ):
        counts = {name: shapes.count(name) * 19 / len(shapes) for name in set(shapes)}
        assert set(counts) == {*KIT, "shorter block"}
        # The small block finds a free place more often; so do, among the others, narrow shapes.
        assert all(0.7 < share < 1.4 for share in counts.values()), counts


def test_shapes_do_not_tell_who_belongs_together(all_roles: list[Roles]) -> None:
    same = sum(first.object == second.object for _, (first, second), _ in all_roles)
    alike = sum(dragged[0].object == distractor.object for _, dragged, (distractor,) in all_roles)
    assert 25 < same < 85 and 25 < alike < 85  # 1 in 19 is 53


def test_it_is_a_task_of_l4_alone_with_the_published_sentence() -> None:
    spec = task_spec("same_texture")
    assert spec.levels == ("L4",) and (spec.oracle_max_steps, spec.max_steps) == (4, 6)
    sentence = "Put all objects with the same texture as {base_obj} into it."
    assert spec.template == sentence
    assert {sample_episode("same_texture", level="L4", seed=s).problem.prompt.text for s in range(9)} == {
        sentence
    }
