"""Whether the lowest declared version of every dependency works, in an environment of its own.

    python benchmarks/lowest_versions.py [--torch REQUIREMENT] [--mujoco a,b,…] [--tests PATH …] [--json FILE]

Resolves all extras of pyproject.toml to the lowest versions that have wheels for this Python, torch left out,
and installs them beside the package. Runs there: oracle demonstrations, their verification with replays, an
evaluation with its report, a video, the export to LeRobot, the digests of played episodes and, with a torch,
5 training steps. With `--mujoco`, these versions are installed in turn and their digests of played episodes
recorded in tests/golden/played_digests.json. With `--tests`, these tests run, too. Exit status 1 if anything
fails.
"""

import argparse
import itertools
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
import venv
from pathlib import Path
from typing import Any  # nested JSON

from sim import circumstances

ROOT = Path(__file__).parents[1]
DIGESTS = "tests/properties/test_played_digests.py"
NO_TORCH = 'torch ; python_version < "3"\n'  # uv's way to leave a dependency out
TAIL = 2000  # characters of the output of a failed check


class Environment:
    """A virtual environment with lowest versions.

    Args:
        folder: Where to build it; also the working directory of the checks.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.python = folder / "env/bin/python"
        venv.create(folder / "env", with_pip=True)
        self._pip("uv")

    def install(self, torch: str) -> dict[str, str]:
        """Install the lowest versions and the package, then torch; return the declared packages' versions."""
        override, pins = self.folder / "override.txt", self.folder / "pins.txt"
        override.write_text(NO_TORCH, encoding="utf-8")
        resolution = ["--resolution", "lowest-direct", "--only-binary", ":all:", "--override", str(override)]
        form = ["--no-annotate", "--no-header", "-o", str(pins)]
        self._uv("compile", str(ROOT / "pyproject.toml"), "--extra", "dev", *resolution, *form)
        self._uv("install", "-r", str(pins), "--only-binary", ":all:")
        self._uv("install", "--no-deps", str(ROOT))
        if torch:
            self._pip(torch)  # pip's settings may name a wheel on disk; uv does not read them
        lines = pins.read_text(encoding="utf-8").splitlines()
        return {name: version for name, version in (line.split("==") for line in lines) if name in declared()}

    def install_mujoco(self, version: str) -> None:
        """Replace MuJoCo; from 4.0 on it is two packages, which may lack files after a change."""
        packages = ("mujoco", "mujoco-core")
        self._uv("install", f"mujoco=={version}", *(f"--reinstall-package={name}" for name in packages))

    def check(self, arguments: list[str]) -> dict[str, Any]:
        """Run Python; return command, seconds and whether it passed, else the end of its output."""
        # A cache of its own, and neither the source tree nor user packages of the caller.
        env = {**os.environ, "NUMBA_CACHE_DIR": str(self.folder / "numba"), "PYTHONNOUSERSITE": "1"}
        env.pop("PYTHONPATH", None)
        start = time.perf_counter()
        done = subprocess.run(
            [str(self.python), *arguments],
            cwd=self.folder,
            env=env,
            capture_output=True,
            text=True,
            check=False,
        )
        command = " ".join(arguments).removeprefix("-m ").replace(str(ROOT), ".")
        result = {"command": command, "wall_s": round(time.perf_counter() - start, 1)}
        output = {} if done.returncode == 0 else {"output": (done.stdout + done.stderr)[-TAIL:]}
        return {**result, "passed": done.returncode == 0, **output}

    def _uv(self, verb: str, *arguments: str) -> None:
        python = ["-p", str(self.python)]
        subprocess.run(
            [self.python, "-m", "uv", "pip", verb, "-q", *python, *arguments], check=True, cwd=ROOT
        )

    def _pip(self, requirement: str) -> None:
        subprocess.run([self.python, "-m", "pip", "install", "-q", requirement], check=True)


def declared() -> set[str]:
    """Return the names of the packages that pyproject.toml declares."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = itertools.chain(project["dependencies"], *project["optional-dependencies"].values())
    return {re.split(r"[^\w-]", requirement)[0] for requirement in requirements}


def checks(torch: str, tests: list[str]) -> list[list[str]]:
    """Return the arguments of Python for each check, in order."""
    verbs = [
        "generate --tasks rotate,sweep_without_exceeding --episodes 10 --out data --workers 2",
        "data verify data --replay 2",
        "data export-lerobot data lerobot",
        "evaluate --policy oracle --tasks rotate,twist,novel_noun --levels L1 --episodes 3 --out oracle",
        "report oracle",
        "demo rotate --out rotate.mp4",
        *(["train --data data --preset nano --schedule.steps 5 --out run"] if torch else []),
    ]
    commands = [["-m", "openvima", *verb.split()] for verb in verbs]
    pytest = ["-m", "pytest", "-q", "-W", "default", "-p", "no:cacheprovider"]
    return [*commands, *([*pytest, str(ROOT / path)] for path in (DIGESTS, *tests))]


def main() -> int:
    """Build the environment, run the checks, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    torch = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()[-1]
    parser.add_argument("--torch", default=torch, help="requirement for torch; empty leaves training out")
    parser.add_argument("--mujoco", default="", help="versions whose played episodes are recorded")
    parser.add_argument(
        "--tests", nargs="*", default=[], help="tests to run, too, relative to the repository"
    )
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        environment = Environment(Path(folder))
        lowest = environment.install(options.torch)
        results = []
        for arguments in checks(options.torch, options.tests):
            results.append(environment.check(arguments))
            print(results[-1]["command"], flush=True, file=sys.stderr)
        for version in filter(None, options.mujoco.split(",")):
            environment.install_mujoco(version)
            results.append({"mujoco": version, **environment.check([str(ROOT / DIGESTS)])})
    print(" ".join(f"{name}=={version}" for name, version in lowest.items()))
    for result in results:
        print(
            f"{'passed' if result['passed'] else 'FAILED':<8}{result['wall_s']:>6.1f} s  {result['command']}"
        )
        print(result.get("output", ""), end="")
    if options.json:
        content = {**circumstances(), "torch": options.torch, "lowest": lowest, "checks": results}
        options.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return 0 if all(result["passed"] for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
