"""Score a served policy inside the original benchmark, VIMA-Bench in PyBullet (docs/original_benchmark.md).

Run `openvima serve POLICY --port 8000`, and this in the benchmark's environment, which needs msgpack and
websockets besides and nothing of openvima. Every episode is a file; the same command resumes.
"""

import argparse
import json
import os
import re
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace

import msgpack
import numpy as np
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

LEVELS = {
    "L1": "placement_generalization",
    "L2": "combinatorial_generalization",
    "L3": "novel_object_generalization",
    "L4": "novel_task_generalization",
}


def _pack(a):
    return {b"__ndarray__": True, b"data": a.tobytes(), b"dtype": a.dtype.str, b"shape": a.shape}


def _unpack(m):
    return np.ndarray(m[b"shape"], m[b"dtype"], m[b"data"]) if b"__ndarray__" in m else m


def specifications():
    """Options of the benchmark for each task of each level."""
    np.bool8 = np.bool_  # the benchmark uses this name
    try:
        import vima_bench
    except ImportError as error:
        raise SystemExit(f"vima_bench: {error}; docs/original_benchmark.md says how to set it up.") from error
    # Time limits of the arm count CPU time, so that scores do not depend on the load of the machine.
    vima_bench.env.base.time = SimpleNamespace(time=time.process_time)
    return {level: vima_bench.PARTITION_TO_SPECS["test"][name] for level, name in LEVELS.items()}


def arrays(views):
    """Return the images of both views as the server expects them."""
    return {view: np.ascontiguousarray(views[view], np.uint8) for view in ("front", "top")}


def encode_prompt(env):
    """Return the prompt of the running episode; images in the order in which its text names them."""
    images = []
    for name in dict.fromkeys(re.findall(r"{(\w+)}", env.prompt)):
        asset = env.prompt_assets[name]
        info = asset["segm"]["obj_info"]  # a dict for an object, a list of dicts for a scene
        objects = [
            {"object_id": int(one["obj_id"]), "object": one["obj_name"], "texture": one["obj_color"]}
            for one in ([info] if isinstance(info, dict) else info)
        ]
        image = {"name": name, "kind": asset["placeholder_type"], "objects": objects}
        images.append({**image, "rgb": arrays(asset["rgb"]), "segm": arrays(asset["segm"])})
    return {"text": env.prompt, "images": images}


def encode_observation(env, seen):
    """Return an observation. Arm and tool, which are no objects, are marked as table in the segmentation."""
    ids = np.ones(256, np.uint8)
    known = [0, 255, *env.meta_info["obj_id_to_info"]]
    ids[known] = known
    segm = {view: ids[image] for view, image in arrays(seen["segm"]).items()}
    return {"rgb": arrays(seen["rgb"]), "segm": segm, "ee": int(seen["ee"])}


def reset(env, seed):
    """Begin the episode of a seed; where the benchmark fails to place its objects, it samples again."""
    env.global_seed = seed
    for redraws in range(100):
        try:
            return env.reset(), redraws
        except Exception as error:  # of several types
            problem = error
    raise SystemExit(f"seed {seed}: the benchmark began no episode in 100 attempts: {problem!r}")


def play(env, ask, seed):
    """Play an episode of at most two steps more than the oracle's and return its record."""
    seen, redraws = reset(env, seed)
    prompt, steps, done = {"prompt": encode_prompt(env)}, 0, False
    while not done and steps < env.task.oracle_max_steps + 2:
        seen, _, done, info = env.step(ask({**encode_observation(env, seen), **prompt}))
        prompt, steps = {}, steps + 1  # the server keeps the prompt
    outcome = {name: bool(info[name]) for name in ("success", "failure")}
    return {"seed": seed, **outcome, "steps": steps, "redraws": redraws, "prompt": env.prompt}


def write(path, value):
    """Write a JSON file atomically."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(f".part{os.getpid()}")
    part.write_text(json.dumps(value, indent=1) + "\n")
    os.replace(part, path)


@contextmanager
def policy_at(url):
    """Connect to a policy server; yield what it says about the policy, and a function that asks it."""
    token = os.environ.get("OPENVIMA_SERVE_TOKEN")
    headers = {"Authorization": f"Bearer {token}"} if token else None
    with ExitStack() as stack:
        try:
            options = {"compression": None, "ping_interval": None, "proxy": None}
            connection = stack.enter_context(connect(url, **options, additional_headers=headers))
            about = msgpack.unpackb(connection.recv(timeout=60))
        except (OSError, ValueError, WebSocketException) as error:
            raise SystemExit(
                f"no policy server at {url}: {error}; start one: openvima serve POLICY"
            ) from error

        def ask(request):
            try:
                connection.send(msgpack.packb(request, default=_pack))
                answer = connection.recv(timeout=600)
            except (OSError, WebSocketException) as error:
                raise SystemExit(f"lost {url}: {error!r}; the same command resumes.") from error
            if isinstance(answer, str):
                raise SystemExit(f"{url} refused a request: {answer}")
            action = msgpack.unpackb(answer, object_hook=_unpack)
            return {part: np.array(value, np.float32) for part, value in action.items()}

        yield about, ask


def play_cell(args, level, task):
    """Play the episodes of a task and level that have no record yet, in one environment."""
    paths = [args.out / level / task / f"{args.seed + n}.json" for n in range(args.episodes)]
    if missing := [path for path in paths if not path.exists()]:
        options = specifications()[level][task]
        from vima_bench import make

        env = make(task, task_kwargs=options, modalities=["rgb", "segm"], hide_arm_rgb=not args.show_arm)
        with policy_at(args.url) as (_, ask):
            for path in missing:
                write(path, play(env, ask, int(path.stem)))
        env.close()
    return level, task, [json.loads(path.read_text())["success"] for path in paths]


def interval(wins, played, z=1.96):
    """Return the 95 % Wilson score interval of a success rate."""
    rate, over = wins / played, z * z / played
    half = z * (rate * (1 - rate) / played + over / played / 4) ** 0.5
    return (rate + over / 2 - half) / (1 + over), (rate + over / 2 + half) / (1 + over)


def report(cells):
    """Print a table in Markdown: each task with its interval, and the mean of each level."""
    print("| level | task | successes | 95 % interval |\n| --- | --- | ---: | ---: |")
    for level in dict.fromkeys(level for level, _, _ in cells):
        outcomes = {task: wins for at, task, wins in cells if at == level}
        for task, wins in outcomes.items():
            low, high = interval(sum(wins), len(wins))
            print(f"| {level} | {task} | {sum(wins)} of {len(wins)} | {low:.0%} to {high:.0%} |")
        print(f"| {level} | **mean** | **{np.mean([np.mean(wins) for wins in outcomes.values()]):.1%}** | |")


def main():
    """Play the episodes that have no record yet and print the table of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the records of one policy")
    parser.add_argument("--url", default="ws://127.0.0.1:8000", help="address of the policy server")
    parser.add_argument("--levels", default="L1,L2,L3,L4", help="default: L1,L2,L3,L4")
    parser.add_argument("--tasks", default="", help="default: all tasks of each level")
    parser.add_argument("--episodes", type=int, default=50, help="per task and level; default: 50")
    parser.add_argument("--seed", type=int, default=40000, help="of the first episode; default: 40000")
    parser.add_argument("--workers", type=int, default=1, help="tasks played at once; default: 1")
    parser.add_argument("--show-arm", action="store_true", help="draw the arm, which hides objects")
    args = parser.parse_args()
    specs = specifications()
    levels, tasks = args.levels.split(","), list(filter(None, args.tasks.split(",")))
    known = {task for level in levels for task in specs.get(level, ())}
    for kind, given, allowed in (("level", levels, set(specs)), ("task", tasks, known)):
        if unknown := sorted(set(given) - allowed):
            parser.error(f"there is no {kind} {unknown[0]!r}; allowed: {', '.join(sorted(allowed))}.")
    if args.episodes < 1 or args.workers < 1 or args.seed < 0:
        parser.error("--episodes and --workers must be at least 1, and --seed at least 0.")

    with policy_at(args.url) as (metadata, _):
        about = {"show_arm": args.show_arm, "server": metadata}
    path = args.out / "policy.json"
    if path.exists() and json.loads(path.read_text()) != about:
        raise SystemExit(
            f"{args.out} has records of another policy or with other options; choose another --out."
        )
    write(path, about)
    chosen = [(level, task) for level in levels for task in specs[level] if task in (tasks or specs[level])]
    with ProcessPoolExecutor(args.workers) as pool:
        cells = list(pool.map(play_cell, *zip(*((args, *cell) for cell in chosen), strict=True)))
    report(cells)


if __name__ == "__main__":
    main()
