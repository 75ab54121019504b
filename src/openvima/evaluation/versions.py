"""Versions of what results depend on."""

import platform
from importlib.metadata import PackageNotFoundError, version

from openvima import __version__
from openvima.env.registration import ENVIRONMENT_VERSION

_PACKAGES = ("numpy", "numba", "mujoco", "gymnasium")


def versions(*, with_torch: bool) -> dict[str, str]:
    """List the versions that can change the outcome of an episode.

    Args:
        with_torch: Whether networks take part.

    Returns:
        Package name to version, without importing any of them.
    """
    found = {
        "openvima": __version__,
        "environments": f"v{ENVIRONMENT_VERSION}",
        "python": platform.python_version(),
    }
    for package in (*_PACKAGES, *(("torch",) if with_torch else ())):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found
