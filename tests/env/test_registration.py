"""Names for Gymnasium appear whatever is imported first."""

import subprocess
import sys

import pytest

from openvima.env.registration import environment_id
from openvima.tasks import list_tasks


@pytest.mark.parametrize("imports", ["import gymnasium, openvima", "import openvima, gymnasium"])
def test_the_order_of_imports_does_not_matter(imports: str) -> None:
    code = f"{imports}; print(*(name for name in gymnasium.registry if name.startswith('openvima/')))"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    assert sorted(result.stdout.split()) == [environment_id(task) for task in list_tasks()]


TASK = """
from openvima.tasks import register_task, task_spec
rotate = task_spec("rotate")
for _ in range(2):
    register_task("mine", family="x", template="x.", oracle_max_steps=1, pools=rotate.pools)(rotate.sample)
"""


@pytest.mark.parametrize(
    "imports", ["import gymnasium, openvima", "import openvima, gymnasium", "import gymnasium"]
)
def test_a_task_has_its_id_whenever_it_is_registered(imports: str) -> None:
    code = f"{imports}{TASK}{imports}\nprint(gymnasium.make('openvima/mine-v1').unwrapped.task)"
    result = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert (result.stdout.strip(), result.stderr) == ("mine", "")


def test_gymnasium_imports_the_package_that_an_id_names() -> None:
    code = "import gymnasium; print(gymnasium.make('openvima:openvima/rotate-v1').unwrapped.task)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "rotate"


def test_openvima_alone_does_not_import_gymnasium() -> None:
    code = "import openvima, sys; print('gymnasium' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"
