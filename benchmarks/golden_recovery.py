"""Poses of bodies in recorded prompt images that do not tell them, found by fitting.

The public benchmark's record of a prompt's scene image names its bodies, but not where they lie. Here each
body is drawn again and again until position, height and yaw, for boxes also the size, show what the image
shows. Agreement with such an image is a weaker statement than with one whose poses are recorded: a handful of
fitted numbers stand against the hundreds of pixels of a body.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from golden_scenes import RecordedImage
from openvima.catalog import object_spec
from openvima.render import CAMERAS, VIEWS, Rasteriser, View, unproject
from openvima.scene import BACKGROUND_ID, Placement, Pose, Scene

FIRST_ID = 2  # of a body in a prompt's scene image, after floor and sheet
_NUM_YAWS = 48  # headings tried at first …
_NUM_STARTS = 3  # … of which the best are refined
_FIRST_STEPS = (4e-3, 4e-3, 4e-3, 0.06, 4e-3, 4e-3, 4e-3)  # x, y, z (m), yaw (rad), size x, y, z (m)
_NUM_HALVINGS = 9  # of the steps: to 0.01 mm, and 1e-4 rad
_LAYER_M = 0.004  # between the heights tried for a body that another one covers
_WRONG_BODY = 3 * 255.0  # what a pixel costs that shows the body and should not, or the other way round


@dataclass(frozen=True, slots=True, eq=False)
class _Target:
    """One body of an image: where it shows, in what colours, and where others may hide it."""

    body: dict[View, np.ndarray]  # bool, shape (128, 256)
    others: dict[View, np.ndarray]
    rgb: dict[View, np.ndarray]


def recover_scene(
    image: RecordedImage, shown: tuple[tuple[str, str], ...], known: Scene, rasteriser: Rasteriser
) -> Scene:
    """Find where the bodies of a prompt's scene image lie.

    Args:
        image: What the benchmark drew.
        shown: Object and texture names of its bodies; ids count from 2.
        known: The episode's scene; bodies of the same kind have the same size.
        rasteriser: Draws with the benchmark's assets.

    Returns:
        The bodies at the poses that show the image best; ids count from 2.
    """
    bodies = [
        _guess(object_id, name, texture, known)
        for object_id, (name, texture) in enumerate(shown, start=FIRST_ID)
    ]
    targets = {body.id: _target(image, body.id) for body in bodies}
    visible = [body for body in bodies if targets[body.id].body["top"].any()]
    found = {body.id: _recover(body, targets[body.id], rasteriser) for body in visible}
    for body in bodies:  # those hidden from above lie under another
        if body.id not in found:
            cover = min(
                visible, key=lambda other: _column_distance(targets[other.id], targets[body.id]), default=body
            )
            start = body.at(found[cover.id].pose if cover.id in found else body.pose)
            found[body.id] = _recover_below(start, targets[body.id], rasteriser)
    return Scene(tuple(found[body.id] for body in bodies))


def _guess(object_id: int, name: str, texture: str, known: Scene) -> Placement:
    same = [placement for placement in known.placements if placement.object == name]
    same = [placement for placement in same if placement.texture == texture] or same
    size = same[0].size if same else object_spec(name).size_max
    return Placement(object_id, name, texture, size, Pose((0.5, 0.0, 0.0)))


def _target(image: RecordedImage, object_id: int) -> _Target:
    body = {view: image.segm[view] == object_id for view in VIEWS}
    others = {
        view: (image.segm[view] >= FIRST_ID) & (image.segm[view] < BACKGROUND_ID) & ~body[view]
        for view in VIEWS
    }
    return _Target(body, others, {view: image.rgb[view] for view in VIEWS})


def _column_distance(a: _Target, b: _Target) -> float:
    """How far apart two bodies lie in the front view, in pixels across."""
    columns = [np.nonzero(target.body["front"])[1] for target in (a, b)]
    if not all(len(c) for c in columns):
        return math.inf
    return abs(float(columns[0].mean() - columns[1].mean()))


def _recover(body: Placement, target: _Target, rasteriser: Rasteriser) -> Placement:
    """Try headings, each where the body's centre then shows in the right place, and refine the best."""
    cost = _cost(body, target, rasteriser)
    starts = []
    for k in range(_NUM_YAWS):
        turned = body.at(Pose.planar(body.pose.x, body.pose.y, 2 * math.pi * k / _NUM_YAWS))
        placed = _shifted(turned, target, rasteriser)
        starts.append((cost(placed), placed))
    starts.sort(key=lambda start: start[0])
    return min((_refined(placed, cost) for _, placed in starts[:_NUM_STARTS]), key=lambda result: result[0])[
        1
    ]


def _recover_below(body: Placement, target: _Target, rasteriser: Rasteriser) -> Placement:
    """Lower a body from where another one covers it to where it shows best, and refine that."""
    cost = _cost(body, target, rasteriser)
    depths = range(math.ceil(body.pose.z / _LAYER_M) + 1)
    return _refined(min((body.at(body.pose.moved(dz=-k * _LAYER_M)) for k in depths), key=cost), cost)[1]


def _shifted(body: Placement, target: _Target, rasteriser: Rasteriser) -> Placement:
    """Move a body so that its centre shows where it should, first from above, then from the front."""
    for view in ("top", "front"):
        drawn = rasteriser.scene(Scene((body,)), views=(view,))[view].segm == body.id
        if not (drawn.any() and target.body[view].any()):
            continue
        (x0, y0), (x1, y1) = (
            unproject(np.argwhere(mask).mean(axis=0)[::-1], CAMERAS[view])
            for mask in (drawn, target.body[view])
        )
        if view == "top":
            body = body.at(body.pose.moved(x1 - x0, y1 - y0))
        else:  # a height z shows in the front view as if it lay at x − z
            body = body.at(body.pose.moved(dz=x0 - x1))
    return body


def _cost(body: Placement, target: _Target, rasteriser: Rasteriser) -> Callable[[Placement], float]:
    """Return what tells how badly a placement of the body shows the image."""

    def cost(placement: Placement) -> float:
        total = 0.0
        for view, image in rasteriser.scene(Scene((placement,))).items():
            ours, theirs = image.segm == body.id, target.body[view]
            both = ours & theirs
            num_wrong = (theirs & ~ours).sum() + (ours & ~theirs & ~target.others[view]).sum()
            difference = image.rgb[:, both].astype(np.int16) - target.rgb[view][:, both]
            total += _WRONG_BODY * float(num_wrong) + float(np.abs(difference).sum())
        return total

    return cost


def _refined(start: Placement, cost: Callable[[Placement], float]) -> tuple[float, Placement]:
    """Improve a placement by steps along each of its numbers, halved whenever none helps."""
    best, best_cost = _refined_numbers(start, cost, num_free=4)
    if best_cost > 0 and object_spec(start.object).kind in ("box", "compound"):
        best, best_cost = _refined_numbers(best, cost, num_free=7)
    return best_cost, best


def _refined_numbers(
    start: Placement, cost: Callable[[Placement], float], *, num_free: int
) -> tuple[Placement, float]:
    best, best_cost = start, cost(start)
    scale, num_halvings = 1.0, 0
    while num_halvings <= _NUM_HALVINGS and best_cost > 0:
        improved = False
        for axis in range(num_free):
            for sign in (1.0, -1.0):
                trial = _stepped(best, axis, sign * scale * _FIRST_STEPS[axis])
                if (trial_cost := cost(trial)) < best_cost:
                    best, best_cost, improved = trial, trial_cost, True
                    break
        if not improved:
            scale, num_halvings = scale / 2, num_halvings + 1
    return best, best_cost


def _stepped(body: Placement, axis: int, step: float) -> Placement:
    if axis < 3:
        return body.at(body.pose.moved(*(step if k == axis else 0.0 for k in range(3))))
    if axis == 3:
        return body.at(body.pose.rotated(step))
    x, y, z = (max(length + (step if k == axis - 4 else 0.0), 1e-3) for k, length in enumerate(body.size))
    return replace(body, size=(x, y, z))
