"""Hypothesis strategies for the shared records."""

import math

from hypothesis import strategies as st

from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Pose
from openvima.scene.scene import normalised

angles = st.floats(-math.pi, math.pi)
coordinates = st.floats(-2.0, 2.0)
vectors = st.tuples(coordinates, coordinates, coordinates)


def _is_not_tiny(components: tuple[float, float, float, float]) -> bool:
    return sum(c * c for c in components) > 1e-3


quaternions = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(_is_not_tiny).map(lambda components: normalised(components))
)
poses = st.builds(Pose, vectors, quaternions)
flat_poses = st.builds(
    lambda x, y, yaw: Pose.planar(x, y, yaw),
    st.floats(WORKSPACE_LOW[0], WORKSPACE_HIGH[0]),
    st.floats(WORKSPACE_LOW[1], WORKSPACE_HIGH[1]),
    angles,
)
seeds = st.integers(0, 2**63 - 1)
