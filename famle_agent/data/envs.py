"""From whatever a user calls an environment to environments, one per situation."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, count
from types import FunctionType
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv

from famle_agent.data.description import FAULTS, ONLOOKERS, env_attribute, plain_spec
from famle_agent.data.transitions import EnvSource, check_names
from famle_agent.utils.errors import in_situation
from famle_envs.faults import make_faulty
from famle_envs.profile import Profile
from famle_envs.situation import Situation

__all__ = ["EnvLike", "SituationEnvs", "SituationsLike", "opened", "situation_envs"]

EnvLike = gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]] | Situation | Mapping[str, Any] | str
"""An environment, a factory of one, or the situation of one."""
SituationsLike = Sequence[EnvLike] | Mapping[str, EnvLike]
"""One per situation; the keys of a mapping are the names of the situations."""


@dataclass(frozen=True)
class SituationEnvs:
    """One environment per training situation.

    Attributes:
        sources: Each environment that the user gave, or what makes it.
        situations: What each situation is called; no two alike.
    """

    sources: list[EnvSource]
    situations: list[str]


def situation_envs(env: VecEnv, envs: SituationsLike | None, episode_length: int = 0) -> SituationEnvs:
    """Makes one environment per training situation.

    Args:
        env: The agent's own environment; situations are put into new ones of its kind.
        envs: What the user gave; None takes the training situations that the environment names.
        episode_length: Steps that an episode of each must be able to last; 0 asks for no more than their time limit.

    Raises:
        ValueError: No situation is given or known, a robot cannot have one, the name of one is not a line of text, the
            spaces of one differ from the agent's, one has a profile other than the simulator's, ends its episodes too
            early, or stands for two situations; or a factory returns an environment that was there before.
    """
    if envs is None:
        envs = list(env_attribute(env, "training_situations", ()))
        if not envs:
            raise ValueError(
                "This environment names no training situations. Call meta_learn(envs) with a list that holds one "
                "environment, one factory or one Situation per situation; famle_envs.faults.actuator_faults(env) "
                "lists the faults of its motors."
            )
    names, items = _listed(envs)
    sources, labels = [_source(env, item, episode_length) for item in items], list[str]()
    _check_different(items)
    there = _all_robots()
    for i, source in enumerate(sources):
        made = source if isinstance(source, gym.Env) else source()
        if made is not source and id(made.unwrapped) in there:
            raise ValueError(
                "A factory returned an environment that was there before. It has to make a new one at each call, which "
                "is closed after use: put the environment itself into the list, or make it in the function."
            )
        try:
            _check_same_spaces(made, env)
            _check_simulated(made)
            _check_time_limit(made, episode_length)
            situation = _get(made, "situation", None)
        finally:
            if made is not source:
                made.close()
        label = situation.label if isinstance(situation, Situation) else f"situation {i}"
        own_names = chain([label], (f"{label} ({j})" for j in count(i)))
        labels.append(names[i] if names else next(name for name in own_names if name not in labels))
        check_names(labels)
    return SituationEnvs(sources, labels)


@contextmanager
def opened(source: EnvSource, situation: str) -> Iterator[gym.Env[Any, Any]]:
    """Makes an environment and closes it in the end; one that is there already stays open."""
    with in_situation(situation):
        env = source if isinstance(source, gym.Env) else source()
    try:
        yield env
    finally:
        if env is not source:
            env.close()


def _check_different(items: Sequence[EnvLike]) -> None:
    """Refuses one environment, or one function that was written for several, in the place of two situations."""
    robots = [item.unwrapped for item in items if isinstance(item, gym.Env)]
    if len({id(robot) for robot in robots}) < len(robots):
        raise ValueError(
            "The list of environments holds the same one twice, which has one situation at a time: make one for each."
        )
    functions = list({id(item): item for item in items if isinstance(item, FunctionType)}.values())
    for i, function in enumerate(functions):
        for other in functions[:i]:
            if _says(function) == _says(other):
                raise ValueError(
                    f"Two factories, {function.__qualname__}, do the same: a function that is made in a loop sees the "
                    "loop's last value when it is called. Bind the value: lambda situation=situation: ..."
                )


def _says(function: FunctionType) -> tuple[Any, ...]:
    """What decides what a function returns, but for the rest of the world."""
    cells = [id(cell) for cell in function.__closure__ or ()]
    bound = [function.__defaults__ or (), tuple(sorted((function.__kwdefaults__ or {}).items()))]
    return function.__code__, cells, [id(value) for values in bound for value in values]


def _all_robots() -> dict[int, gym.Env[Any, Any]]:
    """All environments of this process, which belong to whoever made them, by identity."""
    return {id(item): item for item in gc.get_objects() if issubclass(type(item), gym.Env)}


def _listed(envs: SituationsLike) -> tuple[list[str], list[EnvLike]]:
    """The names that the user gave to the situations, if any, and what has them."""
    one = isinstance(envs, Mapping) and not all(callable(x) or isinstance(x, _ENV_LIKE) for x in envs.values())
    if one or isinstance(envs, (str, Situation, gym.Env, VecEnv)) or not isinstance(envs, (Sequence, Mapping)):
        raise ValueError(
            f"meta_learn(envs) needs a list with one environment, factory or Situation per situation, or a mapping "
            f"from their names to these, got {type(envs).__name__}; put a single one into a list."
        )
    if len(envs) == 0:
        raise ValueError("meta_learn(envs) needs at least one environment, factory or Situation.")
    if not isinstance(envs, Mapping):
        return [], list(envs)
    check_names(list(envs))
    return list(envs), list(envs.values())


_ENV_LIKE = (gym.Env, Situation, Mapping, str)


def _source(env: VecEnv, item: EnvLike, episode_length: int) -> EnvSource:
    if isinstance(item, gym.Env):
        return item
    if isinstance(item, (Situation, Mapping, str)):
        spec = plain_spec(env, ONLOOKERS | FAULTS)
        if spec is None:
            raise ValueError(
                "Situations need a registered environment without wrappers; give environments or factories instead, "
                "such as lambda: famle_envs.faults.FaultWrapper(MyEnv(), situation)."
            )
        # Who only looks on, as the Monitor that Stable-Baselines3 puts around an environment, is no part of the robot.
        spec = replace(spec, additional_wrappers=())
        if episode_length:
            spec = replace(spec, max_episode_steps=episode_length)
        return partial(make_faulty, spec, item, render_mode=None)
    if not callable(item):
        raise ValueError(
            f"A situation is an environment, a factory of one, a Situation, a mapping or a name, got "
            f"{type(item).__name__}."
        )
    return partial(_make_from_factory, item)


def _make_from_factory(factory: Callable[[], gym.Env[Any, Any]]) -> gym.Env[Any, Any]:
    made = factory()
    if not isinstance(made, gym.Env):
        raise ValueError(f"A factory must return a Gymnasium environment, got {type(made).__name__}.")
    return made


def _check_same_spaces(made: gym.Env[Any, Any], env: VecEnv) -> None:
    if made.observation_space != env.observation_space or made.action_space != env.action_space:
        raise ValueError(
            f"Each situation must have the agent's spaces, {env.observation_space} and {env.action_space}; "
            f"got {made.observation_space} and {made.action_space}."
        )


def _check_simulated(made: gym.Env[Any, Any]) -> None:
    profile = _get(made, "profile", None)
    if isinstance(profile, Profile) and not profile.is_simulator:
        raise ValueError(
            f"The profile {profile.name!r} stands for the robot that an agent is made for, and no agent meta-learns on "
            "it. Meta-learn on environments without a profile, then run the agent on this one."
        )


def _check_time_limit(made: gym.Env[Any, Any], episode_length: int) -> None:
    limit = None if made.spec is None else made.spec.max_episode_steps
    if limit is not None and limit < episode_length:
        raise ValueError(
            f"Simulated episodes should have {episode_length} steps (the setting episode_length), but the environment "
            f"ends them after {limit}. Make it with gym.make(..., max_episode_steps={episode_length}), or give "
            "episode_length=0 to take its own limit."
        )


def _get(env: gym.Env[Any, Any], name: str, default: Any) -> Any:
    return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else default
