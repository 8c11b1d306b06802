"""Deprecated name of :mod:`famle_envs.robot_env`."""

import warnings

from famle_envs.engines.world import HOLDING_TORQUE as HOLDING_FORCE
from famle_envs.engines.world import Array
from famle_envs.robot_env import RobotEnv as BulletEnv

__all__ = ["HOLDING_FORCE", "Array", "BulletEnv"]

warnings.warn(
    "famle_envs.bullet_env is famle_envs.robot_env now; the old name goes with the next version.",
    DeprecationWarning,
    stacklevel=2,
)
