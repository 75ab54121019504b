"""The machine-readable catalogue that the data is compared with, where it is present."""

import json
import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def catalogue() -> dict:
    path = Path(os.environ.get("OPENVIMA_SPEC", "../shared/spec")) / "catalogue.json"
    if not path.is_file():
        pytest.skip(f"{path} is absent; OPENVIMA_SPEC names the folder that holds it")
    return json.loads(path.read_text())
