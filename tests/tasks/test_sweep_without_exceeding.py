"""Area, line and zone of `sweep_without_exceeding` follow its specification."""

import numpy as np
import pytest

from openvima.scene import InZone, NeverTouches, Problem, ZoneKeptClear
from openvima.tasks import sample_episode


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode("sweep_without_exceeding", seed=seed).problem for seed in range(1000)]


@pytest.mark.slow
def test_bounds_line_and_zones_have_the_published_sizes(problems: list[Problem]) -> None:
    line_xs = []
    for problem in problems:
        line, bounds = sorted((p for p in problem.scene.placements if p.fixed), key=lambda p: p.object)
        assert (line.object, bounds.object) == ("line", "three-sided rectangle")
        assert bounds.size[:2] == pytest.approx((0.27, 0.27))
        assert line.size[:2] == pytest.approx((0.3375, 0.04))
        assert (bounds.pose.x, bounds.pose.y, line.pose.y) == (pytest.approx(0.41), 0.0, 0.0)
        assert bounds.pose.yaw_rad == pytest.approx(-np.pi / 2) == line.pose.yaw_rad
        line_xs.append(line.pose.x)
        goal, (touches, clear) = problem.goals[0], problem.constraints
        assert isinstance(goal, InZone)
        assert isinstance(touches, NeverTouches) and isinstance(clear, ZoneKeptClear)
        zone = goal.zone
        assert zone.x - zone.size_x / 2 == pytest.approx(line.pose.x + 0.035)
        assert zone.x + zone.size_x / 2 == pytest.approx(0.56)
        assert (zone.y, zone.size_y) == (0.0, pytest.approx(0.27))
        assert clear.zone == zone
        assert (touches.zone.x, touches.zone.y) == (line.pose.x, 0.0)
        assert (touches.zone.size_x, touches.zone.size_y) == pytest.approx((0.04, 0.3375))
        assert touches.name == "line"
        assert {g.relative_to for g in problem.goals} == {line.id}
    assert 0.3425 <= min(line_xs) < 0.344 and 0.4355 < max(line_xs) <= 0.437


@pytest.mark.slow
def test_the_line_lies_anywhere_in_its_range(problems: list[Problem]) -> None:
    line_xs = [p.pose.x for problem in problems for p in problem.scene.placements if p.object == "line"]
    counts, _ = np.histogram(line_xs, bins=10, range=(0.3425, 0.437))
    assert ((counts - 100) ** 2 / 100).sum() < 27.9  # chi-square, 9 degrees, p = 0.001
