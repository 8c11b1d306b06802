"""The robots that the package knows, and the settings of each: one YAML file a robot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import yaml
from stable_baselines3.common.vec_env import VecEnv

from famle_agent.agents.config import Hyperparameters

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

__all__ = ["Robot", "known_robots", "make_env", "robot_of"]


@dataclass(frozen=True)
class Robot:
    """An entry of ``hyperparams/``: a robot, its environment and its settings in all modes.

    Attributes:
        name: Its short name.
        env_id: The Gymnasium id; empty for the settings of an unknown environment.
        modes: Settings by mode: ``paper`` is the paper's text, ``original`` the authors' public code, ``ours`` what we
            found to be best.
        rivals: What the agents without embeddings change of a mode, by mode and name of the method; tuned for them.
    """

    name: str
    env_id: str
    modes: dict[str, dict[str, Any]]
    rivals: dict[str, dict[str, dict[str, Any]]]

    @property
    def pretrained(self) -> Traversable | None:
        """The file of the agent that the package ships for this robot, if it ships one."""
        file = files("famle_agent").joinpath("pretrained", f"{self.name}.zip")
        return file if file.is_file() else None

    def hyperparameters(self, mode: str, rival: str = "", **overrides: Any) -> Hyperparameters:
        """The settings of a mode with some changed.

        Args:
            mode: The mode.
            rival: The method, where it is not FAMLE.
            **overrides: Settings to change.

        Raises:
            TypeError: An override is no setting, or of the wrong type.
            ValueError: The mode is unknown, or a value is out of range.
        """
        if mode not in self.modes:
            raise ValueError(f"mode must be one of {', '.join(self.modes)}, got {mode!r}.")
        tuned = self.rivals.get(mode, {}).get(rival, {})
        return Hyperparameters.from_dict({**self.modes[mode], **tuned, **overrides})


@cache
def known_robots() -> dict[str, Robot]:
    """The robots that ``hyperparams/`` describes, by short name."""
    robots = {}
    for file in sorted(files("famle_agent").joinpath("hyperparams").iterdir(), key=lambda file: file.name):
        if file.name.endswith(".yaml"):
            entry = yaml.safe_load(file.read_text())
            name = file.name.removesuffix(".yaml")
            robots[name] = Robot(name, entry.pop("env_id"), rivals=entry.pop("rivals", {}), modes=entry)
    return robots


def robot_of(env_id: str | None) -> Robot:
    """The entry of a Gymnasium id, or that of an unknown environment."""
    for robot in known_robots().values():
        if env_id is not None and robot.env_id == env_id:
            return robot
    return known_robots()["default"]


def make_env(env: str | gym.Env[Any, Any] | VecEnv) -> gym.Env[Any, Any] | VecEnv:
    """Makes an environment from a robot's short name or a Gymnasium id; passes anything else through.

    Raises:
        ValueError: The name is neither a known robot nor a registered id.
    """
    if not isinstance(env, str):
        return env
    robots = {name: robot.env_id for name, robot in known_robots().items() if robot.env_id}
    try:
        return gym.make(robots.get(env, env))
    except (gym.error.Error, ImportError) as error:
        raise ValueError(
            f"Cannot make the environment {env!r} ({error}). Give a robot ({', '.join(robots)}), a registered "
            "Gymnasium id or an environment."
        ) from error
