"""Physics and robot: worlds on MuJoCo, an exact UR5, the two primitives."""

from openvima.sim.world import Execution, World

__all__ = ["Execution", "World"]
