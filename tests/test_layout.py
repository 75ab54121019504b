"""The rules of the source tree: who may import whom, and what stays light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "openvima"

# Lowest first; a package imports only from those before it (and from its own files).
ORDER = (
    "html",
    "catalog",
    "scene",
    "render",
    "perception",
    "sim",
    "tasks",
    "env",
    "video",
    "data",
    "policies",
    "detector",
    "serving",
    "training",
    "evaluation",
    "report",
    "publishing",
    "studies",
    "studio",
    "cli",
)
FORBIDDEN = {
    "html": {"mujoco", "torch"},
    "catalog": {"mujoco", "torch"},
    "scene": {"mujoco", "torch"},
    "render": {"mujoco", "torch"},
    "perception": {"mujoco", "torch"},
    "sim": {"torch", "openvima.tasks"},
    "tasks": {"mujoco", "torch", "openvima.sim"},
    "env": {"torch"},
    "video": {"torch"},
    "policies": {"mujoco", "openvima.sim", "openvima.env"},
    "detector": {"mujoco", "openvima.sim", "openvima.env"},
    "serving": {"mujoco", "torch", "openvima.sim", "openvima.env"},
    "training": {"mujoco", "openvima.sim", "openvima.env"},
}


def imported_modules(file: Path) -> set[str]:
    modules = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} has a relative import"
            modules.add(node.module or "")
    return modules


@pytest.mark.parametrize("package", ORDER)
def test_a_package_imports_only_from_lower_ones(package: str) -> None:
    above = {f"openvima.{name}" for name in ORDER[ORDER.index(package) + 1 :]}
    for file in sorted([*SOURCE.glob(f"{package}.py"), *(SOURCE / package).rglob("*.py")]):
        for module in imported_modules(file):
            for banned in above | FORBIDDEN.get(package, set()):
                inside = module == banned or module.startswith(banned + ".")
                assert not inside, f"{file.relative_to(SOURCE)} imports {module}"


def module_name(file: Path) -> str:
    parts = file.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_within(package: str) -> dict[str, set[str]]:
    """Which modules of a package each of its modules imports, at module level or inside functions."""
    files = {module_name(file): file for file in (SOURCE / package).rglob("*.py")}
    graph: dict[str, set[str]] = {}
    for name, file in files.items():
        targets = imported_modules(file)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                inner = {f"{node.module}.{alias.name}" for alias in node.names} & files.keys()
                targets |= inner
                if len(inner) == len(node.names):  # modules of a package, none of its own names
                    targets.discard(node.module or "")
        graph[name] = (targets & files.keys()) - {name}
    return graph


def cycle_in(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other, or lead to such; empty if there are none."""
    graph = {name: set(targets) for name, targets in graph.items()}
    while leaves := {name for name, targets in graph.items() if not targets}:
        graph = {name: targets - leaves for name, targets in graph.items() if name not in leaves}
    return sorted(graph)


@pytest.mark.parametrize("package", ORDER)
def test_no_modules_of_a_package_import_each_other(package: str) -> None:
    assert cycle_in(imports_within(package)) == []


def test_data_imports_torch_in_its_adapter_only() -> None:
    for file in (SOURCE / "data").rglob("*.py"):
        assert file.name == "torch_dataset.py" or "torch" not in imported_modules(file)


def test_openvima_and_its_list_of_tasks_load_nothing_heavy() -> None:
    code = (
        "import openvima, sys; openvima.list_tasks(); "
        "heavy = {'torch', 'mujoco', 'numba', 'matplotlib', 'av', 'pyarrow'}; "
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_packages_list_their_public_names_without_importing_them() -> None:
    packages = [
        file.parent for file in SOURCE.rglob("__init__.py") if "lazy_names(" in file.read_text("utf-8")
    ]
    names = [".".join(folder.relative_to(SOURCE.parent).parts) for folder in packages]
    assert {"openvima", "openvima.data", "openvima.evaluation"} <= set(names)
    code = (
        "import importlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    module = importlib.import_module(name)\n"
        "    assert set(module.__all__) <= set(dir(module)), name\n"
        "    assert 'lazy_names' not in dir(module), name\n"
        "print(sorted({'torch', 'mujoco', 'matplotlib', 'av', 'pyarrow'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_simulation_half_works_without_torch() -> None:
    modules = ", ".join(f"openvima.{name}" for name in ("render", "sim", "tasks", "env", "data"))
    code = f"import sys; sys.modules['torch'] = None; import {modules}"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_no_module_prints_outside_the_command_line() -> None:
    for file in SOURCE.rglob("*.py"):
        if file.relative_to(SOURCE).parts[0] == "cli":
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            is_print = isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print"
            assert not is_print, f"{file.relative_to(SOURCE)} prints"
