"""What the tests of tasks share."""

import pytest

from openvima.catalog import Assets
from openvima.catalog.packs import load_assets


@pytest.fixture(scope="session")
def assets() -> Assets:
    return load_assets("procedural")
