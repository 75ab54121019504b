"""Learning rates and seeds are functions of the step."""

import pytest

torch = pytest.importorskip("torch")

from openvima.training.config import ScheduleConfig  # noqa: E402
from openvima.training.loop import learning_rate_at, step_generator, step_seed  # noqa: E402


def shares(steps: int, warmup_steps: int) -> list[float]:
    return [
        learning_rate_at(step, ScheduleConfig(warmup_steps=warmup_steps), peak=1.0, num_steps=steps)
        for step in range(steps)
    ]


@pytest.mark.parametrize(("steps", "warmup_steps"), [(1, 0), (1, 100), (2, 1), (7, 100), (300, 20), (300, 0)])
def test_the_rate_rises_to_its_peak_and_then_only_falls(steps: int, warmup_steps: int) -> None:
    values = shares(steps, warmup_steps)
    peak = values.index(max(values))
    assert values[peak] == 1
    assert peak == min(warmup_steps, steps // 3)
    assert values[: peak + 1] == sorted(values[: peak + 1])
    assert values[peak:] == sorted(values[peak:], reverse=True)
    assert all(0 < value <= 1 for value in values)


def test_the_rise_is_a_line_and_the_fall_half_a_cosine() -> None:
    values, schedule = shares(100, 9), ScheduleConfig(warmup_steps=9)
    assert values[:9] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
    assert learning_rate_at(55, schedule, peak=1, num_steps=101) == pytest.approx(0.5)
    assert learning_rate_at(100, schedule, peak=1, num_steps=100) == pytest.approx(0)
    assert learning_rate_at(1000, schedule, peak=1, num_steps=100) == pytest.approx(0)


def test_the_fall_may_end_early_and_above_zero() -> None:
    schedule = ScheduleConfig(warmup_steps=7000, decay_steps=17_000, final_learning_rate=1e-7)
    settings = {"schedule": schedule, "peak": 1e-4, "num_steps": 47_000}
    assert learning_rate_at(7000, **settings) == pytest.approx(1e-4)
    assert learning_rate_at(15_500, **settings) == pytest.approx((1e-4 + 1e-7) / 2)
    assert learning_rate_at(24_000, **settings) == learning_rate_at(46_999, **settings) == 1e-7
    short = {**settings, "num_steps": 9000}  # then the warm-up is a third, and the fall ends with the run
    assert learning_rate_at(3000, **short) == pytest.approx(1e-4)
    assert learning_rate_at(9000, **short) == pytest.approx(1e-7)


def test_seeds_differ_between_runs_purposes_and_steps_and_stay_the_same_for_ever() -> None:
    drawn = {
        step_seed(seed, purpose, step) for seed in (0, 1) for purpose in ("a", "b") for step in range(50)
    }
    assert len(drawn) == 200
    assert all(0 <= seed < 2**63 for seed in drawn)
    assert step_seed(0, "order", 0) == 3471081512423777433  # resumed runs rely on it


def test_generators_are_independent_of_the_global_one() -> None:
    torch.manual_seed(1)
    first = torch.rand(3, generator=step_generator(4, "test", 2))
    torch.manual_seed(2)
    second = torch.rand(3, generator=step_generator(4, "test", 2))
    assert torch.equal(first, second)
    assert not torch.equal(first, torch.rand(3, generator=step_generator(4, "test", 3)))
