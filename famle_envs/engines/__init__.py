"""The physics engines that a robot can run in; none is imported before a robot asks for one."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import gymnasium as gym

if TYPE_CHECKING:
    from famle_envs.engines.world import World

__all__ = ["ENGINES", "make_world", "resolve_engine"]

ENGINES = ("pybullet", "mujoco")
"""The engines by the names of the packages that they need; the first one that is installed is the default."""

_WORLDS = {"pybullet": ("bullet", "BulletWorld"), "mujoco": ("mujoco", "MujocoWorld")}
_REMEDIES = {
    "pybullet": '`pip install "famle[pybullet]"`; where PyBullet has no wheel, pip needs a compiler to build it. '
    "Without the argument `engine`, the robot runs in an engine that is installed.",
    "mujoco": "`pip install mujoco`.",
}


def resolve_engine(name: str | None) -> str:
    """Returns the name of an engine; None takes PyBullet where it is installed, else MuJoCo.

    Raises:
        ValueError: There is no engine of that name.
    """
    if name is None:
        return next((engine for engine in ENGINES if find_spec(engine)), ENGINES[-1])
    if name not in ENGINES:
        raise ValueError(f"engine must be None or one of {', '.join(ENGINES)}, got {name!r}.")
    return name


def make_world(engine: str, *args: Any) -> World:
    """Makes the world of a robot.

    Args:
        engine: One of :data:`ENGINES`.
        *args: A :class:`~famle_envs.engines.world.Body`, its :class:`~famle_envs.engines.world.Steps` and a
            :class:`~famle_envs.engines.world.Marker` or None.

    Raises:
        gymnasium.error.DependencyNotInstalled: The engine is not installed.
    """
    module, world = _WORLDS[engine]
    try:
        made: World = getattr(import_module(f"famle_envs.engines.{module}"), world)(*args)
    except ModuleNotFoundError as error:
        if error.name != engine:
            raise
        raise gym.error.DependencyNotInstalled(f"{engine} is not installed: {_REMEDIES[engine]}") from error
    return made
