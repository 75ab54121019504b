"""Folders whose tests need torch are left out where it is not installed; examples may take any time."""

from importlib.util import find_spec

from hypothesis import settings

collect_ignore = [] if find_spec("torch") else ["detector", "policies", "training"]
settings.register_profile("any time", deadline=None)
settings.load_profile("any time")
