"""Which episodes a policy solves with the other attribute in the prompt, by how alike the objects are in it.

    python experiments/openvima_small/swapped_attribute.py SCORES [SCORES ...]

Each SCORES is the folder of an evaluation of `same_texture` or `same_shape` with the ablation
`swapped_attribute`. Two of three objects belong to the base. A policy that compares by the attribute in the
prompt alone picks those that are alike in it first, and else takes any: the last column is its success rate.
"""

import sys
from collections import defaultdict
from pathlib import Path

from openvima.catalog.packs import load_assets
from openvima.evaluation.results import Results
from openvima.scene import Placement
from openvima.tasks import sample_episode
from openvima.training.pretraining.pairs import profile

# By whether the distractor and how many of the two targets are like the base.
EXPECTED = {(1, 2): 1 / 3, (1, 1): 0.0, (1, 0): 0.0, (0, 2): 1.0, (0, 1): 1 / 2, (0, 0): 1 / 3}


def main() -> None:
    """Print a table in Markdown."""
    assets = load_assets("procedural")

    def profile_of(placement: Placement) -> str:
        mesh = assets.geometry(placement.object, placement.size, placement.scale).visual
        return profile(placement.object, mesh.vertices.reshape(-1, 3))

    def texture_of(placement: Placement) -> str:
        return placement.texture

    attributes = {"same_texture": (texture_of, profile_of), "same_shape": (profile_of, texture_of)}
    solved: dict[tuple, list[bool]] = defaultdict(list)
    for folder in map(Path, sys.argv[1:]):
        for row in Results.read(folder / "results.json").rows:
            if row.ablation != "swapped_attribute" or row.task not in attributes:
                continue
            own, other = attributes[row.task]
            for outcome in row.outcomes:
                episode = sample_episode(
                    row.task, level=row.level, seed=outcome.seed, domain="eval", assets=assets
                )
                placements = episode.problem.scene.placements
                base = next(each for each in placements if each.fixed)
                alike = [0, 0]  # distractor, targets
                for each in placements:
                    is_target = own(each) == own(base)
                    alike[is_target] += each is not base and other(each) == other(base)
                solved[row.task, row.level, *alike].append(outcome.success)
    print("| task | distractor alike | targets alike | solved | by the attribute alone |")
    print("|---|---:|---:|---:|---:|")
    for (task, level, distractor, targets), each in sorted(solved.items()):
        rate = 100 * EXPECTED[distractor, targets]
        print(f"| {task}, {level} | {distractor} | {targets} | {sum(each)} of {len(each)} | {rate:.0f} % |")


if __name__ == "__main__":
    main()
