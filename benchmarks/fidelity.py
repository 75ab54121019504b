"""Agreement of images with VIMA-Bench, by task.

    python benchmarks/fidelity.py --scenes DIR --assets DIR [--json FILE]

Draws recorded scenes and all their prompt images with the original asset pack, both views. Compared are
bodies of at least 30 pixels (segmentation, intersection over union) and whole images (mean absolute
difference of colours, of 255). Bodies that the benchmark let overlap at equal heights count as one.

The recordings lack the poses of bodies in prompt scenes. These are recovered from the images, and their
agreement is listed separately as "recovered".

A folder of scenes holds `TASK-SEED.json` (objects with the poses and shapes that the benchmark had, and
prompt images with their objects) and `TASK-SEED.npz` (its images). Poses are those of centres of mass.
The record of a prompt's scene image names its bodies, but not where they lie: each body is drawn again and
again until position, height and yaw, for boxes also the size, show what the image shows. Agreement with such
an image is a weaker statement: a handful of fitted numbers stand against the hundreds of pixels of a body.
"""

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from openvima.catalog import Assets, Vector3, object_spec
from openvima.catalog.original import OriginalAssets
from openvima.render import CAMERAS, VIEWS, Rasteriser, View, empty_labels, stamp, unproject
from openvima.scene import (
    BACKGROUND_ID,
    FIRST_OBJECT_ID,
    ObjectImage,
    Placement,
    Pose,
    Prompt,
    PromptFill,
    Scene,
    SceneImage,
)

SWEPT_MAGNIFICATION = 7.0  # of the small block in prompt images
FLAT_THICKNESS_M = 1e-4  # heights that differ by less count as equal
MIN_PIXELS = 30  # smaller remainders of bodies are not compared: a pixel more or less would decide

Views = dict[str, np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedImage:
    """What the benchmark drew: per view colours (3, 128, 256) and object ids (128, 256), uint8."""

    rgb: Views
    segm: Views


@dataclass(frozen=True, slots=True, eq=False)
class GoldenPrompt:
    """One recorded prompt image.

    Args:
        name: Its placeholder in the prompt.
        image: The benchmark's image.
        candidates: What an image of one object may show. Its pose is always the same; its size and scale are
            those of the same object in the scene, of which there may be several, or the scales of any body in
            the scene where the image is an example for an adjective. Empty for images of scenes.
        shown: Object and texture names of an image of a scene, in the order of their ids from 2 on. Where
            they lie is not recorded.
    """

    name: str
    image: RecordedImage
    candidates: tuple[ObjectImage, ...]
    shown: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, eq=False)
class GoldenScene:
    """One recorded scene.

    Args:
        task: Name of the task.
        seed: Seed of the benchmark.
        scene: The objects at their link-frame poses.
        image: The benchmark's images of it.
        prompts: The images of the prompt.
    """

    task: str
    seed: int
    scene: Scene
    image: RecordedImage
    prompts: tuple[GoldenPrompt, ...]


def read_scene(path: Path) -> GoldenScene:
    """Read one scene; its images lie beside `path` under the same name, with the suffix .npz."""
    record = json.loads(path.read_text(encoding="utf-8"))
    with np.load(path.with_suffix(".npz")) as images:
        return _golden_scene(record, {**images})


def _golden_scene(record: dict[str, Any], images: Views) -> GoldenScene:
    scene = Scene(tuple(_placement(body) for body in record["objects"]), record["end_effector"])
    return GoldenScene(
        task=record["task"],
        seed=record["seed"],
        scene=scene,
        image=_recorded(images, ""),
        prompts=tuple(_prompt(name, asset, scene, images) for name, asset in record["assets"].items()),
    )


def _prompt(name: str, asset: dict[str, Any], scene: Scene, images: Views) -> GoldenPrompt:
    is_object = asset["type"] == "object"
    return GoldenPrompt(
        name,
        _recorded(images, f"asset/{name}/"),
        _candidates(name, asset["objects"][0], scene) if is_object else (),
        () if is_object else tuple((body["name"], body["texture"]) for body in asset["objects"]),
    )


def _recorded(images: Views, prefix: str) -> RecordedImage:
    return RecordedImage(
        {view: images[f"{prefix}rgb_{view}"] for view in VIEWS},
        {view: images[f"{prefix}segm_{view}"] for view in VIEWS},
    )


def link_pose(body: dict[str, Any]) -> Pose:
    """Convert the recorded pose of a body's centre of mass to that of its link frame."""
    x, y, z = body["pos"]
    qx, qy, qz, qw = body["quat_xyzw"]
    offset = Pose(object_spec(body["name"]).com_offset)
    return Pose((x, y, z), (qx, qy, qz, qw)) @ offset.inverse()


def _placement(body: dict[str, Any]) -> Placement:
    size, scale = size_and_scale(body)
    return Placement(
        id=body["id"],
        object=body["name"],
        texture=body["texture"],
        size=size,
        pose=link_pose(body),
        fixed=body["category"] == "fixed",
        scale=scale,
    )


def size_and_scale(body: dict[str, Any]) -> tuple[Vector3, Vector3]:
    """Find the nominal size and task scale with which the catalogue gives the recorded shapes.

    Args:
        body: An object record; its shapes hold either full extents of boxes or scales of meshes.
    """
    spec = object_spec(body["name"])
    shapes = body["shapes"]
    x, y, z = shapes[0]["dims"]
    if spec.kit_scale is not None:
        plain = (0.003 * spec.kit_scale, 0.003 * spec.kit_scale, 0.001 * spec.kit_scale / 1.1)
        return spec.size_max, (x / plain[0], y / plain[1], z / plain[2])
    if body["name"] == "container":
        return (x, y, spec.size_min[2]), (1.0, 1.0, 1.0)
    if body["name"] == "three-sided rectangle":
        return (shapes[1]["dims"][1], x, 0.0), (1.0, 1.0, 1.0)
    if spec.kind == "mesh":
        return spec.size_max, (1.0, 1.0, 1.0)
    return (x, y, z), (1.0, 1.0, 1.0)


def _candidates(name: str, shown: dict[str, Any], scene: Scene) -> tuple[ObjectImage, ...]:
    """What the image of one object may show, as far as the record of the scene tells."""
    same_object = [placement for placement in scene.placements if placement.object == shown["name"]]
    same_both = [placement for placement in same_object if placement.texture == shown["texture"]]
    sizes = [placement.size for placement in same_both or same_object]
    sizes = sizes or [object_spec(shown["name"]).size_max]  # all sizes that a scene does not tell are fixed
    scales = [(1.0, 1.0, 1.0)]
    if name.startswith("demo_"):  # examples have the scales between which the scene's objects differ
        scales += [placement.scale for placement in scene.placements]
    elif same_both:  # images in neutral gray do not give away the scale
        scales = [placement.scale for placement in same_both]
    magnification = SWEPT_MAGNIFICATION if shown["name"] == "small block" else 1.0
    body = Placement(0, shown["name"], shown["texture"], sizes[0], Pose((0.0, 0.0, 0.0)))
    forms = dict.fromkeys((size, scale) for size in sizes for scale in scales)
    return tuple(ObjectImage(replace(body, size=size, scale=scale), magnification) for size, scale in forms)


def interpenetrating(scene: Scene, assets: Assets) -> list[set[int]]:
    """Group the bodies that overlap at equal heights: which one shows is left to rounding in the benchmark.

    Returns:
        Disjoint sets of two or more object ids.
    """
    maps = []
    for placement in scene.placements:
        labels, heights = empty_labels()
        stamp(labels, heights, placement, assets)
        maps.append((placement.id, labels > 0, heights))
    groups: list[set[int]] = []
    for i, (a, mask_a, heights_a) in enumerate(maps):
        for b, mask_b, heights_b in maps[i + 1 :]:
            if (mask_a & mask_b & (np.abs(heights_a - heights_b) < FLAT_THICKNESS_M)).any():
                touching = [group for group in groups if a in group or b in group]
                groups = [group for group in groups if group not in touching]
                groups.append({a, b}.union(*touching))
    return groups


def ious(
    ours: np.ndarray, theirs: np.ndarray, *, first_id: int, groups: list[set[int]]
) -> dict[tuple[int, ...], float]:
    """Compare two segmentation images body by body, leaving out what is smaller than 30 pixels in both.

    Args:
        ours: Object ids, shape (H, W), uint8.
        theirs: The same.
        first_id: Smallest id of an object; what is below, such as the floor, is not compared.
        groups: Sets of ids to be taken as one body.

    Returns:
        For every object of that size its ids (several for a group) and its intersection over union.
    """
    grouped = set().union(*groups)
    seen = {int(i) for i in np.union1d(ours, theirs) if first_id <= i < BACKGROUND_ID}
    bodies = [(i,) for i in sorted(seen - grouped)] + [tuple(sorted(group)) for group in groups]
    result = {}
    for ids in bodies:
        a, b = np.isin(ours, ids), np.isin(theirs, ids)
        if max(a.sum(), b.sum()) >= MIN_PIXELS:
            result[ids] = float((a & b).sum() / (a | b).sum())
    return result


def mean_colour_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the mean absolute difference of two colour images, in levels of 255."""
    return float(np.abs(ours.astype(np.int16) - theirs.astype(np.int16)).mean())


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


@dataclass
class Agreement:
    """What was measured: IoU per body and view, colour error (of 255) per image and view."""

    ious: list[float] = field(default_factory=list)
    colour_errors: list[float] = field(default_factory=list)

    def add(
        self,
        ours: RecordedImage,
        theirs: RecordedImage,
        *,
        first_id: int,
        groups: list[set[int]] | None = None,
    ) -> None:
        """Enter the comparison of one image."""
        for view in VIEWS:
            self.ious += ious(
                ours.segm[view], theirs.segm[view], first_id=first_id, groups=groups or []
            ).values()
            self.colour_errors.append(mean_colour_error(ours.rgb[view], theirs.rgb[view]))

    def summary(self) -> dict[str, Any]:
        """Return the numbers of the result file."""
        return {
            "iou_mean": sum(self.ious) / len(self.ious),
            "iou_min": min(self.ious),
            "rgb_mae_max": max(self.colour_errors),
            "rgb_mae_mean": sum(self.colour_errors) / len(self.colour_errors),
            "num_bodies": len(self.ious),
            "num_images": len(self.colour_errors),
        }


@dataclass
class TaskAgreement:
    """One task: images whose poses are recorded, and images whose poses were recovered from them."""

    recorded: Agreement = field(default_factory=Agreement)
    recovered: Agreement = field(default_factory=Agreement)

    def summary(self) -> dict[str, Any]:
        """Return the numbers of the result file."""
        recovered = self.recovered.summary() if self.recovered.ious else None
        return self.recorded.summary() | {"recovered": recovered}


def compare(golden: GoldenScene, rasteriser: Rasteriser, agreement: TaskAgreement) -> None:
    """Draw one scene and its prompt images, and enter how well they agree."""
    agreement.recorded.add(
        scene_image(golden.scene, rasteriser),
        golden.image,
        first_id=FIRST_OBJECT_ID[golden.scene.end_effector],
        groups=interpenetrating(golden.scene, rasteriser.assets),
    )
    for prompt in golden.prompts:
        if prompt.candidates:
            agreement.recorded.add(object_image(prompt, rasteriser), prompt.image, first_id=0)
        else:
            shown = recover_scene(prompt.image, prompt.shown, golden.scene, rasteriser)
            drawn = prompt_image(SceneImage(shown), rasteriser)
            agreement.recovered.add(drawn, prompt.image, first_id=FIRST_ID)


def scene_image(scene: Scene, rasteriser: Rasteriser) -> RecordedImage:
    """Draw a scene."""
    drawn = rasteriser.scene(scene)
    return RecordedImage(
        {view: drawn[view].rgb for view in VIEWS}, {view: drawn[view].segm for view in VIEWS}
    )


def prompt_image(fill: PromptFill, rasteriser: Rasteriser) -> RecordedImage:
    """Draw one image of a prompt."""
    image = rasteriser.prompt(Prompt("{it}", (("it", fill),))).images["it"]
    return RecordedImage(image.rgb, image.segm)


def object_image(prompt: GoldenPrompt, rasteriser: Rasteriser) -> RecordedImage:
    """Draw an image of one object; if the record leaves a choice of scales or sizes, the nearest one."""

    def num_wrong(image: RecordedImage) -> int:
        return sum(int((image.segm[view] != prompt.image.segm[view]).sum()) for view in VIEWS)

    candidates: tuple[ObjectImage, ...] = prompt.candidates
    return min((prompt_image(fill, rasteriser) for fill in candidates), key=num_wrong)


def main() -> None:
    """Compare all scenes of a folder, print a table, and write it as JSON if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=Path, required=True, help="folder of recorded scenes")
    parser.add_argument("--assets", type=Path, required=True, help="checkout with the original asset pack")
    parser.add_argument("--json", type=Path, help="file to write the result to")
    arguments = parser.parse_args()
    tasks: dict[str, TaskAgreement] = {}
    rasteriser = Rasteriser(OriginalAssets(arguments.assets))
    for golden in map(read_scene, sorted(arguments.scenes.glob("*.json"))):
        compare(golden, rasteriser, tasks.setdefault(golden.task, TaskAgreement()))
    summaries = {task: agreement.summary() for task, agreement in sorted(tasks.items())}
    print(f"{'task':28} bodies images  IoU mean  IoU min  colour error mean    max")
    for task, row in summaries.items():
        print(f"{task:28} {_cells(row)}")
        if row["recovered"]:
            print(f"{'  recovered poses':28} {_cells(row['recovered'])}")
    print("Colour errors are of 255.")
    if arguments.json:
        arguments.json.write_text(json.dumps({"tasks": summaries}, indent=2) + "\n", encoding="utf-8")


def _cells(row: dict[str, Any]) -> str:
    return (
        f"{row['num_bodies']:6d} {row['num_images']:6d} {row['iou_mean']:9.5f} {row['iou_min']:8.4f} "
        f"{row['rgb_mae_mean']:18.4f} {row['rgb_mae_max']:6.3f}"
    )


if __name__ == "__main__":
    main()
