"""The two tools of the arm: where they end, and the shape with which they touch.

Both hang at the flange along the vertical tool axis. Heights are those of the arm's tip (`ur5.forward`).
"""

from openvima.catalog.geometry import Vector3

HOVER_TIP_Z_M = 0.32  # above pick and place points
REACH_RESERVE_M = 0.005  # kept below the highest point that the arm can reach

# Suction: a thin needle that ends below the arm's tip.
NEEDLE_BELOW_TIP_M = 0.003
NEEDLE_RADIUS_M = 1e-4  # of the shape that is lowered; the axis itself, nearly
TOUCH_RADIUS_M = 0.001  # the needle's true radius: a body this near to the axis is hit from above
CAPTURE_RADIUS_M = 0.003  # one this near is still caught above bare floor; 2–4 mm measured in VIMA-Bench

# Spatula: an upright blade, its width across the direction of travel.
BLADE_HALF_SIZE_M: Vector3 = (0.0025, 0.025, 0.0575)  # along the travel, across it, up
BLADE_BELOW_TIP_M = 0.005
SWEEP_HOVER_TIP_Z_M = 0.31
SWEEP_TIP_Z_M = 0.005  # leaves 1 mm between the blade and the floor
BLADE_RUN_UP_M = 0.02  # the blade starts this far before pose0 …
BLADE_SHORTFALL_M = 0.05  # … and stops this far before pose1
COMPAT_SHORTFALL_M = 0.003  # what VIMA-Bench's stop tolerance adds to that


def blade_centre_z(tip_z: float) -> float:
    """Height of the blade's centre in metres for a height of the arm's tip."""
    return tip_z - BLADE_BELOW_TIP_M + BLADE_HALF_SIZE_M[2]
