"""Oriented rectangles on the table and their proximity."""

import math
from dataclasses import dataclass

from openvima.scene import Pose, Zone


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A rectangle on the table, rotated by `yaw_rad`.

    Args:
        x, y: Centre in metres.
        yaw_rad: Direction of its first axis.
        half_x, half_y: Half extents along its own axes in metres.
    """

    x: float
    y: float
    yaw_rad: float
    half_x: float
    half_y: float

    @staticmethod
    def of_box(pose: Pose, size_x: float, size_y: float) -> "Rectangle":
        """Footprint of a flat box with its link frame in the centre."""
        return Rectangle(pose.x, pose.y, pose.yaw_rad, size_x / 2, size_y / 2)

    @staticmethod
    def of_zone(zone: Zone) -> "Rectangle":
        """The rectangle of a zone."""
        return Rectangle(zone.x, zone.y, 0.0, zone.size_x / 2, zone.size_y / 2)

    def comes_near(self, other: "Rectangle", margin_m: float = 0.0) -> bool:
        """Whether no axis of either rectangle separates them by `margin_m`.

        Between corners, a gap slightly wider than the margin may still count as near.
        """
        return self.meets_box_around(other, margin_m) and other.meets_box_around(self, margin_m)

    def meets_box_around(self, other: "Rectangle", margin_m: float = 0.0) -> bool:
        """Whether this rectangle is near the other one's bounding box along its own axes."""
        dx, dy = other.x - self.x, other.y - self.y
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        angle = other.yaw_rad - self.yaw_rad
        other_cos, other_sin = abs(math.cos(angle)), abs(math.sin(angle))
        reach_x = self.half_x + other.half_x * other_cos + other.half_y * other_sin + margin_m
        reach_y = self.half_y + other.half_x * other_sin + other.half_y * other_cos + margin_m
        return abs(dx * cos + dy * sin) < reach_x and abs(dy * cos - dx * sin) < reach_y

    def half_width(self, direction_rad: float) -> float:
        """Half of the rectangle's extent along a direction, in metres."""
        angle = direction_rad - self.yaw_rad
        return self.half_x * abs(math.cos(angle)) + self.half_y * abs(math.sin(angle))
