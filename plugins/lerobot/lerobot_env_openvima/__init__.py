"""Environments of openvima for LeRobot, which imports this package and so finds `--env.type=openvima`."""

from lerobot_env_openvima.config import OpenVimaEnvConfig
from lerobot_env_openvima.env import OpenVimaEnv

__all__ = ["OpenVimaEnv", "OpenVimaEnvConfig"]
