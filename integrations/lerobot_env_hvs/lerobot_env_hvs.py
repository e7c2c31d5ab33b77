"""LeRobot's commands import this module by its name: ``--env.type=hvs`` needs no further flag."""

from hvs_suite.lerobot_env import HvsEnvConfig

__all__ = ["HvsEnvConfig"]
