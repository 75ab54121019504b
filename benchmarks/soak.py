"""Whether the simulator survives whatever a policy may send: random valid actions over all tasks and levels.

    python benchmarks/soak.py [--actions N] [--tasks a,b|all] [--seed S] [--compat] [--json FILE]

A third of the actions goes anywhere on the table, a third takes an object anywhere, a third puts one object
onto another; rotations are any four numbers from -1 to 1, or all zero. After every step are checked: the
observation is well formed, every pose is finite and every quaternion has unit length, nothing lies below the
table, and the physics took no more ticks than the limits of settling and sweeping add up to. Exit status 1
if anything was found.
"""

import argparse
import itertools
import json
import math
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from openvima.catalog import Assets
from openvima.env import TabletopEnv
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Scene
from openvima.sim.model import FLOOR_Z_M, TICK_S
from openvima.sim.settling import SETTLE_LIMIT_TICKS
from openvima.sim.spatula import SWEEP_M_S
from openvima.sim.world import Execution, World
from openvima.tasks import list_tasks, task_spec

FIRST_SEED = 2_000_000
SINKING_M = 0.002  # by which the lowest corner may be below the floor: contacts are springs
FARTHEST_M = 3.0  # from the robot; nothing slides that far
# Before the first action, after lifting and after setting down; a sweep settles before, when the spatula is
# lowered and after, and crosses at most the whole table, with a margin for run-up and bow.
_ACROSS_M = math.dist(WORKSPACE_LOW, WORKSPACE_HIGH) + 0.1
LIMIT_TICKS = {
    "suction": 3 * SETTLE_LIMIT_TICKS,
    "spatula": 3 * SETTLE_LIMIT_TICKS + math.ceil(_ACROSS_M / (SWEEP_M_S * TICK_S)),
}


@dataclass(slots=True)
class Findings:
    """What was seen in one task."""

    actions: int = 0
    episodes: int = 0
    solved: int = 0
    failed: int = 0
    moved: int = 0  # actions that changed a pose
    most_ticks: int = 0
    slowest_step_s: float = 0.0
    lowest_z_m: float = math.inf  # of any corner of any object, above the floor
    farthest_m: float = 0.0
    not_settled: int = 0  # steps that ended by a limit
    problems: list[str] = field(default_factory=list)


def random_action(rng: np.random.Generator, scene: Scene) -> dict[str, np.ndarray]:
    """Draw a valid action: anywhere, from an object, or from an object onto an object."""
    low, high = np.array(WORKSPACE_LOW), np.array(WORKSPACE_HIGH)
    points = rng.uniform(low, high, size=(2, 2))
    for row in range(rng.integers(3)):
        placement = scene.placements[rng.integers(len(scene.placements))]
        points[row] = np.clip(placement.pose.position[:2] + rng.normal(0, 0.02, 2), low, high)
    turns = rng.uniform(-1, 1, size=(2, 4)) * (rng.random() < 0.9)
    # Rounding to float32 may leave the table by the last bit.
    points = np.clip(points.astype(np.float32), low.astype(np.float32), high.astype(np.float32))
    poses = zip(points, turns.astype(np.float32), strict=True)
    return {
        f"pose{i}_{name}": value
        for i, pose in enumerate(poses)
        for name, value in zip(("position", "rotation"), pose, strict=True)
    }


def scene_problems(scene: Scene, assets: Assets) -> tuple[list[str], float, float]:
    """Look for poses that cannot be.

    Returns:
        What is wrong; the lowest corner's height above the floor; the largest distance from the robot, in
        metres.
    """
    problems, lowest, farthest = [], math.inf, 0.0
    for placement in scene.placements:
        pose = placement.pose
        if not np.isfinite([*pose.position, *pose.quaternion]).all():
            problems.append(f"object {placement.id} ({placement.object}) has pose {pose}")
            continue
        if abs(math.hypot(*pose.quaternion) - 1) > 1e-6:
            problems.append(f"object {placement.id} has quaternion {pose.quaternion}")
        geometry = assets.geometry(placement.object, placement.size, placement.scale)
        corners = pose.transform(geometry.visual.vertices.reshape(-1, 3))
        lowest = min(lowest, float(corners[:, 2].min()) - FLOOR_Z_M)
        farthest = max(farthest, math.hypot(pose.x, pose.y))
    if lowest < -SINKING_M:
        problems.append(f"an object reaches {-lowest * 1000:.1f} mm below the floor")
    if farthest > FARTHEST_M:
        problems.append(f"an object lies {farthest:.1f} m away")
    return problems, lowest, farthest


def observation_problems(env: TabletopEnv, observation: dict[str, Any]) -> list[str]:
    """Look for what an observation must not hold."""
    problems = [] if env.observation_space.contains(observation) else ["the observation is not in its space"]
    allowed = {0, 1, 255, *(placement.id for placement in env.scene.placements)}
    for view, segm in observation["segm"].items():
        unknown_ids = set(np.unique(segm).tolist()) - allowed
        if unknown_ids:
            problems.append(f"the {view} view shows ids {sorted(unknown_ids)} that no object has")
    return problems


@contextmanager
def recorded_executions() -> Iterator[list[Execution]]:
    """Collect what every `World.execute` reports while the block runs."""
    executions: list[Execution] = []
    original = World.execute

    def execute(self: World, *args: Any, **options: Any) -> Execution:
        executions.append(original(self, *args, **options))
        return executions[-1]

    World.execute = execute  # type: ignore[method-assign]
    try:
        yield executions
    finally:
        World.execute = original  # type: ignore[method-assign]


def soak(task: str, num_actions: int, *, seed: int = 0, compat: bool = False) -> Findings:
    """Send random actions to a task, its levels in turn, and note what was seen."""
    rng = np.random.default_rng([seed, *task.encode()])
    envs = [TabletopEnv(task, level=level, compat=compat) for level in task_spec(task).levels]
    findings = Findings()
    with recorded_executions() as executions:
        for number, env in enumerate(itertools.cycle(envs)):
            if findings.actions >= num_actions:
                return findings
            _play(env, FIRST_SEED + seed + number, rng, findings, num_actions, executions)
    raise AssertionError  # a cycle does not end


def _play(
    env: TabletopEnv,
    seed: int,
    rng: np.random.Generator,
    findings: Findings,
    num_actions: int,
    executions: list[Execution],
) -> None:
    findings.episodes += 1
    place = f"{env.task}, level {env.level}, seed {seed}"
    try:
        env.reset(seed=seed)
        for number in itertools.count():
            place = f"{env.task}, level {env.level}, seed {seed}, step {number}"
            if findings.actions >= num_actions or _step(env, rng, findings, executions, place):
                return
    except Exception as error:  # whatever it is, it is what is looked for
        findings.problems.append(f"{place}: {type(error).__name__}: {error}")


def _step(
    env: TabletopEnv, rng: np.random.Generator, findings: Findings, executions: list[Execution], place: str
) -> bool:
    """Take one step and check it; whether the episode is over."""
    before = env.scene
    action = random_action(rng, before)
    executions.clear()
    findings.actions += 1
    start = time.perf_counter()
    observation, reward, terminated, truncated, info = env.step(action)
    findings.slowest_step_s = max(findings.slowest_step_s, time.perf_counter() - start)
    problems, lowest, farthest = scene_problems(env.scene, env.assets)
    problems += observation_problems(env, observation)
    (execution,) = executions
    if execution.num_ticks > LIMIT_TICKS[env.scene.end_effector]:
        problems.append(f"the step took {execution.num_ticks} ticks")
    if (reward, terminated) != (float(info["success"]), info["success"] or info["failure"]):
        problems.append(f"reward {reward} and terminated {terminated} contradict {info}")
    findings.problems += [f"{place}: {problem}" for problem in problems]
    findings.most_ticks = max(findings.most_ticks, execution.num_ticks)
    findings.lowest_z_m = min(findings.lowest_z_m, lowest)
    findings.farthest_m = max(findings.farthest_m, farthest)
    findings.not_settled += not execution.completed
    findings.moved += env.scene != before
    findings.solved += info["success"]
    findings.failed += info["failure"]
    return terminated or truncated


def table(results: dict[str, Findings]) -> str:
    """Return the findings as lines of text."""
    head = (
        f"{'task':<28}{'actions':>9}{'episodes':>9}{'moved':>7}{'solved':>7}{'failed':>7}{'unsettled':>10}"
        f"{'most ticks':>11}{'slowest ms':>11}{'lowest mm':>10}{'farthest m':>11}{'problems':>9}"
    )
    rows = [
        f"{task:<28}{f.actions:>9}{f.episodes:>9}{f.moved:>7}{f.solved:>7}{f.failed:>7}{f.not_settled:>10}"
        f"{f.most_ticks:>11}{1000 * f.slowest_step_s:>11.0f}{1000 * f.lowest_z_m:>10.2f}{f.farthest_m:>11.2f}"
        f"{len(f.problems):>9}"
        for task, f in results.items()
    ]
    total = sum(f.actions for f in results.values())
    num_problems = sum(len(f.problems) for f in results.values())
    return "\n".join([head, *rows, f"{total} actions, {num_problems} problems"])


def main() -> int:
    """Run, print a table and all problems, and write them as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--actions", type=int, default=10_000, help="actions over all tasks together")
    parser.add_argument("--tasks", default="all", help="names with commas between them, or 'all'")
    parser.add_argument("--seed", type=int, default=0, help="of the actions, and first episode")
    parser.add_argument("--compat", action="store_true", help="follow the original benchmark's oddities")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    tasks = list(list_tasks()) if options.tasks == "all" else options.tasks.split(",")
    share = math.ceil(options.actions / len(tasks))
    results = {task: soak(task, share, seed=options.seed, compat=options.compat) for task in tasks}
    print(table(results))
    problems = [problem for findings in results.values() for problem in findings.problems]
    print("\n".join(problems), file=sys.stderr, end="\n" if problems else "")
    if options.json:
        content = {"limit_ticks": LIMIT_TICKS, "tasks": {task: asdict(f) for task, f in results.items()}}
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
