"""Deprecated name of :mod:`famle_envs.robot_env`."""

import warnings

from famle_envs.robot_env import RobotEnv as BulletEnv

__all__ = ["BulletEnv"]

warnings.warn(
    "famle_envs.bullet_env is famle_envs.robot_env now; the old name goes with the next version.",
    DeprecationWarning,
    stacklevel=2,
)
