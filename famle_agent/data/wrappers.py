"""What stands between a robot and its agent, and what of the numbers that pass may mean something else behind it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Flag, auto
from typing import Any

import gymnasium as gym
from gymnasium import wrappers
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
)

from famle_agent.data.truncate_on_error import TruncateOnError
from famle_envs.faults import FaultWrapper
from famle_envs.wrappers import RandomSituation

__all__ = ["Change", "Layer", "layers", "robot_layers", "vector_layers"]


class Change(Flag):
    """Of what a wrapper changes the meaning. An observation that comes late, or is wrong, means the same."""

    NOTHING = 0
    OBSERVATION = auto()
    ACTION = auto()
    REWARD = auto()
    ANYTHING = OBSERVATION | ACTION | REWARD


@dataclass(frozen=True)
class Layer:
    """A wrapper between a robot and its agent.

    Attributes:
        name: Of its class.
        change: What it changes, or may change.
        is_known: Whether it does so for certain; nobody can say of code that does as it likes.
    """

    name: str
    change: Change
    is_known: bool = True


_GYMNASIUM: dict[type, Change] = {
    **dict.fromkeys(
        (
            *(wrappers.TimeLimit, wrappers.Autoreset, wrappers.PassiveEnvChecker, wrappers.OrderEnforcing, Monitor),
            *(wrappers.RecordEpisodeStatistics, wrappers.RecordVideo, wrappers.HumanRendering),
            *(wrappers.RenderCollection, wrappers.AddWhiteNoise, wrappers.ObstructView),
            *(wrappers.DelayObservation, wrappers.DtypeObservation, wrappers.StickyAction, wrappers.ClipAction),
            *(FaultWrapper, RandomSituation),  # what they change is inside the robot
            TruncateOnError,
        ),
        Change.NOTHING,
    ),
    **dict.fromkeys(
        (
            *(wrappers.TransformObservation, wrappers.NormalizeObservation),
            *(wrappers.FrameStackObservation, wrappers.TimeAwareObservation),
        ),
        Change.OBSERVATION,
    ),
    wrappers.TransformAction: Change.ACTION,
    **dict.fromkeys((wrappers.TransformReward, wrappers.NormalizeReward, wrappers.RepeatAction), Change.REWARD),
    **dict.fromkeys((wrappers.AtariPreprocessing, wrappers.MaxAndSkipObservation), Change.ANYTHING),
}
"""Wrappers whose code is known. Those that are derived from one and change nothing of how it works are alike."""
_OF_VECTORS: dict[type, Change] = {
    **dict.fromkeys((VecMonitor, VecVideoRecorder, VecCheckNan), Change.NOTHING),
    **dict.fromkeys((VecFrameStack, VecTransposeImage, VecExtractDictObs), Change.OBSERVATION),
    VecNormalize: Change.OBSERVATION,
}
_BY_KIND: tuple[tuple[type, str, Change], ...] = (
    (gym.ObservationWrapper, "observation", Change.OBSERVATION),
    (gym.ActionWrapper, "action", Change.ACTION),
    (gym.RewardWrapper, "reward", Change.REWARD),
)
"""Gymnasium's bases, the method by which a heir of each changes something, and what that is."""
_METHODS = frozenset({"step", "reset", "observation", "action", "reward"})


def layers(env: VecEnv, attribute: str) -> list[Layer]:
    """What changes something between an agent and the part of its environment that has an attribute.

    Args:
        env: The agent's environment. Of one in another process, the names of the wrappers are all that is known.
        attribute: Name of the attribute; what is below the wrapper that has it does not matter to it.
    """
    robots = getattr(env.unwrapped, "envs", None)
    inside = robot_layers(robots[0], attribute) if isinstance(robots, list) and robots else _named(env)
    return [layer for layer in (*vector_layers(env), *inside) if layer.change]


def vector_layers(env: VecEnv) -> list[Layer]:
    """The wrappers of a ``VecEnv`` that change something, the outermost first."""
    found = []
    while isinstance(env, VecEnvWrapper):
        change = _OF_VECTORS.get(type(env))
        found.append(Layer(type(env).__name__, Change.ANYTHING, False) if change is None else _layer(env, change))
        env = env.venv
    return [layer for layer in found if layer.change]


def robot_layers(env: gym.Env[Any, Any], attribute: str) -> list[Layer]:
    """The same of a single robot."""
    return [layer for layer in map(_of_wrapper, _outside(env, attribute)) if layer.change]


def _outside(env: gym.Env[Any, Any], attribute: str) -> Iterator[gym.Wrapper[Any, Any, Any, Any]]:
    while isinstance(env, gym.Wrapper) and attribute not in vars(env) and not hasattr(type(env), attribute):
        yield env
        env = env.env


def _of_wrapper(wrapper: gym.Wrapper[Any, Any, Any, Any]) -> Layer:
    kind = type(wrapper)
    if _METHODS & vars(wrapper).keys():
        return Layer(kind.__name__, Change.ANYTHING, False)
    if isinstance(wrapper, wrappers.FlattenObservation) and wrapper.observation_space == wrapper.env.observation_space:
        return Layer(kind.__name__, Change.NOTHING)
    for base in kind.__mro__:
        if base in _GYMNASIUM:
            return Layer(kind.__name__, _GYMNASIUM[base])
        if base in (gym.Wrapper, *(known for known, _, _ in _BY_KIND)):
            continue
        if _METHODS & vars(base).keys():
            break
    return _of_own_code(kind)


def _of_own_code(kind: type) -> Layer:
    bases = (gym.Wrapper, *(known for known, _, _ in _BY_KIND))
    if any(getattr(kind, name) not in [getattr(base, name, None) for base in bases] for name in ("step", "reset")):
        return Layer(kind.__name__, Change.ANYTHING, False)
    change = Change.NOTHING
    for base, _, what in _BY_KIND:
        change |= what if issubclass(kind, base) else Change.NOTHING
    return Layer(kind.__name__, change)


def _layer(env: VecEnvWrapper, change: Change) -> Layer:
    if isinstance(env, VecNormalize):
        # Rewards that are divided by their deviation ask for the same plans.
        change = Change.OBSERVATION if env.norm_obs else Change.NOTHING
    return Layer(type(env).__name__, change)


def _named(env: VecEnv) -> list[Layer]:
    """The wrappers of a robot in another process, which Gymnasium prints as <Outer<Inner<Robot ...>>>."""
    names = re.findall(r"<([\w ]+)", str(env.env_method("__str__", indices=0)[0]))
    robot = next((i for i, name in enumerate(names) if name.endswith(" instance")), len(names) - 2)
    known = {kind.__name__: change for kind, change in _GYMNASIUM.items()}
    found = []
    for name in names[:robot]:
        kind = getattr(wrappers, name, None) if name in wrappers.__all__ else None
        derived = next((known[base.__name__] for base in getattr(kind, "__mro__", ()) if base.__name__ in known), None)
        change = known.get(name, derived)
        found.append(Layer(name, Change.ANYTHING, False) if change is None else Layer(name, change))
    return found
