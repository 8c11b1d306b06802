"""Simulated robots that can break: Gymnasium environments with a ``situation``.

Importing the package registers ``FamleReacher-v0``, ``FamleAnt-v0``, ``FamleQuadruped-v0``, ``FamleA1-v0`` and
``FamleMinitaur-v0``, each in PyBullet where that is installed and in MuJoCo elsewhere, or as the argument ``engine``
says. The description of the A1 is PyBullet's, in both.
"""

import gymnasium as gym

from famle_envs.situation import Situation

__all__ = ["Situation"]

gym.register(
    id="FamleReacher-v0",
    entry_point="famle_envs.reacher:ReacherEnv",
    max_episode_steps=50,
    reward_threshold=30.0,
)
gym.register(
    id="FamleAnt-v0",
    entry_point="famle_envs.ant:AntEnv",
    max_episode_steps=1000,
    reward_threshold=800.0,
)
gym.register(
    id="FamleQuadruped-v0",
    entry_point="famle_envs.quadruped:QuadrupedEnv",
    max_episode_steps=80,
)
gym.register(
    id="FamleA1-v0",
    entry_point="famle_envs.a1:A1Env",
    max_episode_steps=80,
)
gym.register(
    id="FamleMinitaur-v0",
    entry_point="famle_envs.minitaur:MinitaurEnv",
    max_episode_steps=60,
)
