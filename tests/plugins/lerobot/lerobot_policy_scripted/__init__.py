"""A LeRobot policy without learning, as a plugin that LeRobot discovers by the name of the distribution."""

from lerobot_policy_scripted.configuration_scripted import ScriptedConfig

__all__ = ["ScriptedConfig"]
