"""What a planner should maximise, as far as an environment says that of what the agent sees and does."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv

from famle_agent.data.description import as_json, default_arguments, env_attribute
from famle_agent.data.policies import reward_names
from famle_agent.data.probe import same_reward
from famle_agent.data.wrappers import Change, layers, robot_layers
from famle_agent.models.reward import RewardFn, TerminationFn

__all__ = ["other_reward", "planning_reward", "planning_termination"]


def planning_reward(env: VecEnv, name: str) -> tuple[RewardFn | None, bool]:
    """Returns what a planner should maximise in an environment, where it says that.

    Args:
        env: The environment.
        name: What it calls it; empty takes the first of :data:`~famle_agent.data.policies.REWARDS` that it has.

    Returns:
        The function, and whether it is in doubt that it speaks of what the agent sees and does. None where there is
        none, or where a wrapper gives other rewards.

    Raises:
        ValueError: It has nothing of that name; or it has, but a wrapper changes what it would be given, or the robots
            of a ``VecEnv`` have different tasks.
    """
    if name and not env.has_attr(name):
        raise ValueError(f"The environment has no {name!r}; planning_reward must name a function of it, or be empty.")
    known = [reward for reward in reward_names(name) if env.has_attr(reward)]
    if not known:
        return None, False
    changed, doubtful = _changed(env, known[0], "reward_fn", Change.OBSERVATION | Change.ACTION | Change.REWARD)
    if changed and not name:
        return None, False
    if len(tasks := sorted(set(_tasks(env)))) > 1:
        raise ValueError(
            f"The robots of this VecEnv have different tasks ({'; '.join(tasks)}), and an agent plans for one. "
            "Give a reward_fn that finds the task in the observation, or each task an agent of its own."
        )
    reward_fn: RewardFn = env_attribute(env, known[0], None)
    return reward_fn, doubtful and not name


def other_reward(
    env: gym.Env[Any, Any],
    reward_fn: RewardFn,
    names: Sequence[str],
    observation_space: spaces.Box,
    action_space: spaces.Box,
) -> str | None:
    """Names the function by which an environment rewards otherwise than a function does.

    Args:
        env: The environment.
        reward_fn: What it is compared with.
        names: What the environment may call its own; the first that it has counts.
        observation_space: Of both.
        action_space: Of both.

    Returns:
        The name; None where they agree, or where the environment says nothing of what passes its wrappers.
    """
    name = next((name for name in names if env.has_wrapper_attr(name)), None)
    if name is None:
        return None
    if robot_layers(env, name) or same_reward(env.get_wrapper_attr(name), reward_fn, observation_space, action_space):
        return None
    return name


def planning_termination(env: VecEnv) -> TerminationFn | None:
    """Returns where episodes end, if an environment says that of what the agent sees.

    Raises:
        ValueError: A wrapper changes the observations that it speaks of.
    """
    name = "termination_fn"
    if not env.has_attr(name) or any(_changed(env, name, name, Change.OBSERVATION)):
        return None
    termination_fn: TerminationFn = env_attribute(env, name, None)
    return termination_fn


def _changed(env: VecEnv, name: str, argument: str, matters: Change) -> tuple[bool, bool]:
    """Whether wrappers give other rewards than a function of an environment, and whether they may change anything.

    Raises:
        ValueError: A wrapper certainly changes what the function would be given.
    """
    between = [layer for layer in layers(env, name) if layer.change & matters]
    given = [layer.name for layer in between if layer.is_known and layer.change & ~Change.REWARD]
    if given:
        raise ValueError(
            f"The environment's {name} is of what {', '.join(given)} changes; give the one of the wrapped observations "
            f"and actions ({argument}=...), or the environment without that wrapper."
        )
    if doubtful := [layer.name for layer in between if not layer.is_known]:
        warnings.warn(
            f"{', '.join(doubtful)} may change what the environment's {name} is of: who meta-learns takes what happens "
            f"in simulation instead. Where it changes nothing, say {argument}=env.get_wrapper_attr({name!r}).",
            stacklevel=6,
        )
    return any(layer.is_known for layer in between), bool(doubtful)


def _tasks(env: VecEnv) -> list[str]:
    """What each robot of a ``VecEnv`` should do, as far as the arguments of its environment say that."""
    specs: list[EnvSpec | None] = env.get_attr("spec")
    asked = [{} if spec is None else {**default_arguments(spec), **as_json(spec.kwargs)} for spec in specs]
    tasks = [{key: value for key, value in kwargs.items() if key not in _NO_TASK} for kwargs in asked]
    differing = {key for task in tasks for key in task if any(task.get(key) != other.get(key) for other in tasks)}
    return [
        json.dumps({key: task[key] for key in task if key in differing}, default=repr, sort_keys=True) for task in tasks
    ]


_NO_TASK = frozenset({"situation", "profile", "engine", "render_mode"})
