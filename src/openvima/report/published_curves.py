"""Scaling curves of the papers, to stand beside measured ones."""

from collections.abc import Callable, Iterable, Sequence

from openvima.report.published import PublishedModel, published_models
from openvima.report.rate_curves import RateCurve, RatePoint


def model_size_curves(level: str) -> list[RateCurve]:
    """Published success rates of a level over the number of parameters, trained on all data.

    The quantity is the size of the controller, without the text encoder.
    """
    models = [model for model in published_models() if model.data_fraction == 1 and not model.aside]
    return _curves(models, level, name=lambda m: m.model, x=lambda m: m.num_parameters)


def data_fraction_curves(level: str) -> list[RateCurve]:
    """Published success rates of a level over the fraction of the demonstrations used for training."""
    published = [model for model in published_models() if not model.aside]
    fewer = {(model.model, model.size) for model in published if model.data_fraction < 1}
    models = [model for model in published if (model.model, model.size) in fewer]
    return _curves(models, level, name=lambda m: f"{m.model} {m.size}", x=lambda m: m.data_fraction)


def _curves(
    models: Iterable[PublishedModel],
    level: str,
    *,
    name: Callable[[PublishedModel], str],
    x: Callable[[PublishedModel], float],
) -> list[RateCurve]:
    points: dict[str, list[RatePoint]] = {}
    for model in models:
        if level in model.levels:
            rate = model.levels[level]
            points.setdefault(name(model), []).append(RatePoint(x(model), rate / 100, mark=model.mark(level)))
    return [
        RateCurve(name, tuple(sorted(found, key=lambda point: point.x)), published=True)
        for name, found in points.items()
    ]


def size_ticks(curves: Sequence[RateCurve]) -> dict[float, str]:
    """Names of the sizes of curves, as in 2e6: "2M"."""
    return {point.x: f"{point.x / 1e6:.3g}M" for curve in curves for point in curve.points}
