"""Dimensions of the two tools of the arm.

Both point down from the flange. Heights are those of the arm's tip (`ur5.forward`).
"""

from openvima.catalog.geometry import Vector3

HOVER_TIP_Z_M = 0.32  # above pick and place points
REACH_RESERVE_M = 0.005  # kept below the highest point that the arm can reach

# Suction: a thin probe below the arm's tip.
PROBE_BELOW_TIP_M = 0.003
PROBE_RADIUS_M = 1e-4  # of the lowered shape, nearly a line
CONTACT_RADIUS_M = 0.001  # the probe's true radius: bodies this near to the axis are hit from above
CAPTURE_RADIUS_M = 0.003  # grasp distance above bare floor; 2–4 mm measured in VIMA-Bench
FLANK_RADIUS_M = 0.002  # above a fixed body; VIMA-Bench grasps at 1.2 and 1.7 mm, misses at 2.5 mm

# Spatula: an upright plate, its width across the direction of travel.
SPATULA_HALF_SIZE_M: Vector3 = (0.0025, 0.025, 0.0575)  # along the travel, across it, up
SPATULA_BELOW_TIP_M = 0.005
SWEEP_HOVER_TIP_Z_M = 0.31
SWEEP_TIP_Z_M = 0.005  # leaves 1 mm between the spatula and the floor
SPATULA_RUN_UP_M = 0.02  # the spatula starts this far before pose0 …
SPATULA_SHORTFALL_M = 0.05  # … and stops this far before pose1
COMPAT_SHORTFALL_M = 0.003  # what VIMA-Bench's stop tolerance adds to that


def spatula_centre_z(tip_z: float) -> float:
    """Height of the spatula's centre in metres for a height of the arm's tip."""
    return tip_z - SPATULA_BELOW_TIP_M + SPATULA_HALF_SIZE_M[2]
