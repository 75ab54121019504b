"""What the oracle does in the first episodes of every published task and level, by version of MuJoCo.

Bytes of played episodes may change with MuJoCo, those of sampled ones (`test_digests.py`) may not. Running
this file as a script records the installed version. Do so after a meant change, and note it in CHANGELOG.md.
"""

import hashlib
import json
from pathlib import Path

import mujoco
import pytest

from openvima.catalog.partitions import PUBLISHED_LEVELS, PUBLISHED_TASKS
from openvima.data import rollout_oracle
from openvima.env import TabletopEnv
from openvima.tasks import task_spec

RECORD = Path(__file__).parents[1] / "golden" / "played_digests.json"
NUM_SEEDS = 2
COMMAND = "python tests/properties/test_played_digests.py"


def digests(task: str) -> dict[str, str]:
    """Digests of the oracle's actions, of the final poses, of the outcomes and of all images."""
    totals = {part: hashlib.sha256() for part in ("actions", "final_poses", "outcomes", "images")}
    for level in filter(PUBLISHED_LEVELS.__contains__, task_spec(task).levels):
        env = TabletopEnv(task, level=level, domain="eval")
        for seed in range(NUM_SEEDS):
            played = rollout_oracle(env, seed)
            for action in played.actions:
                for array in action.to_arrays().values():
                    totals["actions"].update(array.tobytes())
            totals["final_poses"].update(repr(played.scenes[-1].placements).encode())
            totals["outcomes"].update(repr(played.outcome).encode())
            for view in played.rgb:
                totals["images"].update(played.rgb[view].tobytes())
                totals["images"].update(played.segm[view].tobytes())
    return {part: total.hexdigest()[:16] for part, total in totals.items()}


@pytest.mark.parametrize("task", PUBLISHED_TASKS)
def test_the_oracle_does_what_it_did(task: str) -> None:
    recorded = json.loads(RECORD.read_text(encoding="utf-8"))
    if mujoco.__version__ not in recorded:
        pytest.skip(f"MuJoCo {mujoco.__version__} is not recorded; `{COMMAND}` does so")
    assert digests(task) == recorded[mujoco.__version__][task]


def main() -> None:
    """Record the installed version of MuJoCo beside the others."""
    recorded = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
    recorded[mujoco.__version__] = {task: digests(task) for task in PUBLISHED_TASKS}
    RECORD.write_text(json.dumps(dict(sorted(recorded.items())), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
