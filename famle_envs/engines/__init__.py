"""The physics engines that a robot can run in; none is imported before a robot asks for one."""

from __future__ import annotations

from importlib.util import find_spec

import gymnasium as gym

from famle_envs.engines.world import Body, Marker, Steps, World

__all__ = ["ENGINES", "MissingPackageError", "make_world", "resolve_engine"]

ENGINES = ("pybullet", "mujoco")
"""The engines by the names of the packages that they need; the first one that is installed is the default."""

_WITH_PYBULLET = '`pip install "famle[pybullet]"`, which needs a compiler where PyBullet has no wheel.'
_REMEDIES = {
    "pybullet": f"{_WITH_PYBULLET} Without the argument `engine`, the robot runs in the engine that is installed.",
    "pybullet_data": f"{_WITH_PYBULLET} Both engines read this robot's description from that package.",
    "mujoco": "`pip install mujoco`.",
}
"""What to do where a package is not installed, by its name."""


class MissingPackageError(gym.error.DependencyNotInstalled, ModuleNotFoundError):
    """A package that a robot needs is not installed: an error of Gymnasium's kind and of Python's."""


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


def make_world(engine: str, body: Body, steps: Steps, marker: Marker | None) -> World:
    """Makes the world of a robot.

    Args:
        engine: One of :data:`ENGINES`.
        body: The robot.
        steps: How time passes.
        marker: What pictures show beside the robot.

    Raises:
        MissingPackageError: The engine, or the package that describes the robot, is not installed.
    """
    try:
        if engine == "pybullet":
            from famle_envs.engines.bullet import BulletWorld

            return BulletWorld(body, steps, marker)
        from famle_envs.engines.mujoco import MujocoWorld

        return MujocoWorld(body, steps, marker)
    except ModuleNotFoundError as error:
        if error.name not in _REMEDIES:
            raise
        raise MissingPackageError(f"{error.name} is not installed: {_REMEDIES[error.name]}") from error
