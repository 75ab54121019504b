"""Agreement of images with VIMA-Bench, by task.

    python benchmarks/fidelity.py --scenes DIR --assets DIR [--json FILE]

Draws recorded scenes and all their prompt images with the original asset pack, both views. Compared are
bodies of at least 30 pixels (segmentation, intersection over union) and whole images (mean absolute
difference of colours, of 255). Bodies that the benchmark let overlap at equal heights count as one.

The recordings lack the poses of bodies in prompt scenes. These are recovered from the images, and their
agreement is listed separately as "recovered".
"""

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from golden_recovery import FIRST_ID, recover_scene
from golden_scenes import (
    GoldenPrompt,
    GoldenScene,
    RecordedImage,
    RecordingError,
    interpenetrating,
    ious,
    mean_colour_error,
    read_scenes,
)
from openvima.catalog.original import OriginalAssets
from openvima.errors import OpenVimaError
from openvima.render import VIEWS, Rasteriser
from openvima.scene import FIRST_OBJECT_ID, ObjectImage, Prompt, PromptFill, Scene, SceneImage


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
    try:
        rasteriser = Rasteriser(OriginalAssets(arguments.assets))
        for golden in read_scenes(arguments.scenes):
            compare(golden, rasteriser, tasks.setdefault(golden.task, TaskAgreement()))
    except (RecordingError, OpenVimaError) as error:
        parser.error(str(error))
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
