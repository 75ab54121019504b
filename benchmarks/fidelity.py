"""How close our images are to those of the public benchmark, task by task.

    python benchmarks/fidelity.py --scenes DIR --assets DIR [--json FILE]

Draws recorded scenes with the original asset pack, both views, and the prompt images whose poses are known.
Bodies that the benchmark let overlap at equal heights count as one.
"""

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path

from golden_scenes import GoldenScene, interpenetrating, ious, mean_colour_error, read_scenes
from openvima.catalog.original import OriginalAssets
from openvima.errors import AssetError
from openvima.render import VIEWS, Rasteriser
from openvima.scene import FIRST_OBJECT_ID


@dataclass
class Agreement:
    """What was measured for one task: IoU per body and view, colour error (of 255) per image."""

    ious: list[float] = field(default_factory=list)
    colour_errors: list[float] = field(default_factory=list)
    num_not_redrawn: int = 0

    def summary(self) -> dict[str, float]:
        """Return the numbers of the result file."""
        return {
            "iou_mean": sum(self.ious) / len(self.ious),
            "iou_min": min(self.ious),
            "rgb_mae_max": max(self.colour_errors),
            "rgb_mae_mean": sum(self.colour_errors) / len(self.colour_errors),
            "num_bodies": len(self.ious),
            "num_images": len(self.colour_errors),
            "num_prompt_images_not_redrawn": self.num_not_redrawn,
        }


def compare(golden: GoldenScene, rasteriser: Rasteriser, agreement: Agreement) -> None:
    """Draw one scene and its prompt images, and enter how well they agree."""
    groups = interpenetrating(golden.scene, rasteriser.assets)
    first_id = FIRST_OBJECT_ID[golden.scene.end_effector]
    drawn = rasteriser.scene(golden.scene)
    for view in VIEWS:
        agreement.ious += ious(
            drawn[view].segm, golden.image.segm[view], first_id=first_id, groups=groups
        ).values()
        agreement.colour_errors.append(mean_colour_error(drawn[view].rgb, golden.image.rgb[view]))
    for name, image in rasteriser.prompt(golden.prompt).images.items():
        recorded = golden.prompt_images[name]
        for view in VIEWS:
            agreement.ious += ious(image.segm[view], recorded.segm[view], first_id=0, groups=[]).values()
            agreement.colour_errors.append(mean_colour_error(image.rgb[view], recorded.rgb[view]))
    agreement.num_not_redrawn += golden.num_not_redrawn


def main() -> None:
    """Compare all scenes of a folder, print a table, and write it as JSON if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=Path, required=True, help="folder of recorded scenes")
    parser.add_argument("--assets", type=Path, required=True, help="checkout with the original asset pack")
    parser.add_argument("--json", type=Path, help="file to write the result to")
    arguments = parser.parse_args()
    try:
        rasteriser = Rasteriser(OriginalAssets(arguments.assets))
    except AssetError as error:
        parser.error(str(error))
    tasks: dict[str, Agreement] = {}
    for golden in read_scenes(arguments.scenes):
        compare(golden, rasteriser, tasks.setdefault(golden.task, Agreement()))
    if not tasks:
        parser.error(f"{arguments.scenes} holds no recorded scenes (TASK-SEED.json); give another folder")
    summaries = {task: agreement.summary() for task, agreement in sorted(tasks.items())}
    print(f"{'task':28} bodies images  IoU mean  IoU min  colour error mean    max")
    for task, row in summaries.items():
        print(
            f"{task:28} {row['num_bodies']:6d} {row['num_images']:6d} {row['iou_mean']:9.5f} "
            f"{row['iou_min']:8.4f} {row['rgb_mae_mean']:18.4f} {row['rgb_mae_max']:6.3f}"
        )
    not_redrawn = sum(agreement.num_not_redrawn for agreement in tasks.values())
    print(f"Colour errors are of 255. Without recorded poses or scales, so not compared: {not_redrawn}.")
    if arguments.json:
        arguments.json.write_text(json.dumps({"tasks": summaries}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
