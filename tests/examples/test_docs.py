"""What docs/policies.md says in code and numbers is so."""

import re
from pathlib import Path

import pytest

pytest.importorskip("torch")

from openvima.policies import preset
from openvima.policies.build import policy_size

PAGE = Path(__file__).parents[2] / "docs" / "policies.md"
TEXT = PAGE.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_code_of_the_page_runs_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for kind, code in re.findall(r"^```python(.*?)\n(.*?)^```", TEXT, flags=re.MULTILINE | re.DOTALL):
        if kind.strip() == "no-run":  # needs downloads; its imports are tried all the same
            code = "\n".join(line for line in code.splitlines() if line.startswith("from "))
        exec(compile(code, str(PAGE), "exec"), names)
    assert {"sampling", "MyDetector", "load_t5"} <= names.keys()


def test_the_tables_of_sizes_are_those_of_the_presets() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| (\d.*) \|$", TEXT, flags=re.MULTILINE)
    assert {name for name, _ in rows} > {f"vima-{size}" for size in ("2m", "9m", "200m")}
    for name, row in rows:
        size = policy_size(preset(name))
        counts = [count.total for count in size.parts.values()]
        counts += [size.parameters.total, size.parameters.trainable]
        millions = [f"{count / 1e6:.2f}" for count in counts]
        assert row.split(" | ") == [str(size.width), str(size.num_layers), str(size.num_heads), *millions]


def test_totals_of_the_baselines_are_as_near_to_vima_as_the_page_says() -> None:
    for size in ("2m", "43m", "200m"):
        ours = policy_size(preset(f"vima-{size}")).parameters.total
        for family, share in {"gato": 0.02, "gpt": 0.02, "flamingo": 0.05}.items():
            theirs = policy_size(preset(f"{family}-{size}")).parameters.total
            assert abs(theirs / ours - 1) < share


def test_every_file_that_the_page_links_to_is_there() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", TEXT):
        assert (PAGE.parent / target).exists(), target
