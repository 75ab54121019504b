"""The tabletop world: physics, arm and tools."""
