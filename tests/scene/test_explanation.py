"""What explanations say about choices."""

import pytest

from openvima.scene.explanation import Explanation, ObjectProbability, PlaceProbability


def explained(picks: list[float], places: list[tuple[float, float]]) -> Explanation:
    """Build an explanation of pick probabilities and of pairs of x and probability of places."""
    return Explanation(
        {},
        (),
        {},
        tuple(ObjectProbability(number, {}, (0.5, 0.0), p) for number, p in enumerate(picks)),
        tuple(PlaceProbability("grid", (x, 0.0), p) for x, p in places),
    )


def test_candidates_at_one_place_count_together() -> None:
    places = explained([1.0], [(0.3, 0.3), (0.5, 0.4), (0.31, 0.3)]).distinct_places()
    assert [round(place.probability, 6) for place in places] == [0.6, 0.4]
    assert places[0].position == (0.3, 0.0)


def test_the_second_choice_is_another_place_or_another_object() -> None:
    picked, place, probability = explained([0.9, 0.1], [(0.3, 0.6), (0.5, 0.4)]).second_choice() or (0, 0, 0)
    assert picked.object_id == 0 and place.position == (0.5, 0.0)  # type: ignore[union-attr]
    assert probability == pytest.approx(0.36)
    picked, place, probability = explained([0.6, 0.4], [(0.3, 1.0)]).second_choice() or (0, 0, 0)
    assert picked.object_id == 1 and place is None  # type: ignore[union-attr]
    assert probability == pytest.approx(0.4)
    assert explained([1.0], [(0.3, 1.0)]).second_choice() is None
