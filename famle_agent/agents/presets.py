"""The robots that the package knows, and the settings of each: one YAML file a robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import yaml
from gymnasium.vector import VectorEnv
from stable_baselines3.common.vec_env import VecEnv

from famle_agent.agents.config import Config

_NOTHING: Mapping[str, Any] = {}

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

    def config(self, mode: str, rival: str = "", implied: Mapping[str, Any] = _NOTHING, **overrides: Any) -> Config:
        """The settings of a mode with some changed.

        Args:
            mode: The mode.
            rival: The method, where it is not FAMLE.
            implied: Settings that the kind of agent implies.
            **overrides: Settings to change.

        Raises:
            TypeError: An override is no setting, or of the wrong type.
            ValueError: The mode is unknown, or a value is out of range or has no effect.
        """
        if mode not in self.modes:
            raise ValueError(f"mode must be one of {', '.join(self.modes)}, got {mode!r}.")
        tuned = self.rivals.get(mode, {}).get(rival, {})
        return Config.of({**self.modes[mode], **tuned, **implied, **overrides}, overrides.keys() - implied.keys())


@cache
def known_robots() -> dict[str, Robot]:
    """The robots that ``hyperparams/`` describes, by short name."""
    folder = files("famle_agent").joinpath("hyperparams")
    names = sorted(file.name.removesuffix(".yaml") for file in folder.iterdir() if file.name.endswith(".yaml"))
    entries = {name: yaml.safe_load(folder.joinpath(f"{name}.yaml").read_text()) for name in names}
    any_robot = entries["default"]
    robots = {}
    for name in entries:
        # A file says only what differs: from a robot that it is like, section by section; of how any robot adapts, of
        # the paper's settings, of the paper's for this one.
        entry = whole_entry(entries, name)
        ours, paper = (any_robot[of_any] | entry[mode] for of_any, mode in (("adaptation", "ours"), ("paper", "paper")))
        modes = {"ours": ours, "paper": paper}
        if "original" in entry:
            modes["original"] = modes["paper"] | entry["original"]
        robots[name] = Robot(name, entry["env_id"], modes, entry["rivals"])
    return robots


def whole_entry(entries: Mapping[str, Mapping[str, Any]], name: str, *followed: str) -> Mapping[str, Any]:
    """Fills in what a file leaves to the robot that it is ``like``, and that one to the next.

    Args:
        entries: The files' sections by the names of the robots.
        name: Of the robot.
        *followed: Robots that are like this one.

    Raises:
        ValueError: A robot is like itself in the end, or like one that there is none of.
    """
    if name in followed or name not in entries:
        way = " is like ".join((*followed, name))
        raise ValueError(f"A robot's settings must come to an end: {way}. Name another robot with `like`, or none.")
    own = entries[name]
    return {**whole_entry(entries, own["like"], *followed, name), **own} if "like" in own else own


def robot_of(env_id: str | None) -> Robot:
    """The entry of a Gymnasium id, or that of an unknown environment."""
    for robot in known_robots().values():
        if env_id is not None and robot.env_id == env_id:
            return robot
    return known_robots()["default"]


def make_env(env: str | gym.Env[Any, Any] | VecEnv) -> gym.Env[Any, Any] | VecEnv:
    """Makes an environment from a robot's short name or a Gymnasium id; passes anything else through.

    Raises:
        TypeError: It is no environment, such as the driver of a real robot.
        ValueError: The name is neither a known robot nor a registered id, or it is one of Gymnasium's vector
            environments.
    """
    if isinstance(env, VectorEnv):
        raise ValueError(
            "Gymnasium's vector environments do not tell alike in all their modes where an episode has ended. Give one "
            "of Stable-Baselines3: DummyVecEnv([lambda: gym.make(...)] * n). To drive one of Gymnasium with predict() "
            "yourself, pass as episode_start whose episode ended in the last step (SAME_STEP, DISABLED), or in the one "
            "before it (NEXT_STEP, the default)."
        )
    if isinstance(env, gym.Env | VecEnv):
        return env
    if not isinstance(env, str):
        raise TypeError(
            f"Expected a robot's name, a Gymnasium id, a gymnasium.Env or a VecEnv of Stable-Baselines3, got a "
            f"{type(env).__name__}. Meta-learn in a simulator of the robot. To drive the robot itself, load that agent "
            "without an environment, FAMLE.load(path, reward_fn=...), plan with predict() and report with observe()."
        )
    robots = {name: robot.env_id for name, robot in known_robots().items() if robot.env_id}
    try:
        return gym.make(robots.get(env, env))
    except (gym.error.Error, ImportError) as error:
        raise ValueError(
            f"Cannot make the environment {env!r} ({error}). Give a robot ({', '.join(robots)}), a registered "
            "Gymnasium id or an environment. An id that a package registers begins with it where nobody has imported "
            "that yet, such as 'famle_envs:FamleAnt-v0'."
        ) from error
