"""Export to the LeRobotDataset v3.0 format, without LeRobot."""

from openvima.data.lerobot.dense import frame_layout
from openvima.data.lerobot.export import LerobotConfig, export_lerobot

__all__ = ["LerobotConfig", "export_lerobot", "frame_layout"]
