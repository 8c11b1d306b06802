"""What an environment says of itself: its spaces, its id and arguments, what the parts of an observation are."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, load_env_creator
from stable_baselines3.common.vec_env import VecEnv

from famle_agent.data.wrappers import Change, layers, vector_layers
from famle_envs.faults import FaultWrapper
from famle_envs.profile import Profile
from famle_envs.situation import Situation

__all__ = [
    "FAULTS",
    "ONLOOKERS",
    "as_json",
    "check_spaces",
    "default_arguments",
    "different_arguments",
    "env_attribute",
    "env_id",
    "env_spec",
    "first_env",
    "plain_spec",
    "special_dims",
]


def check_spaces(observation_space: spaces.Space[Any], action_space: spaces.Space[Any]) -> None:
    """Refuses what a dynamics model cannot predict.

    Raises:
        ValueError: A space is no one-dimensional Box, or the actions are not bounded.
    """
    for name, space in (("observation", observation_space), ("action", action_space)):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"The {name} space must be a one-dimensional Box, got {space}. {_as_box(name, space)}")
    box: Any = action_space
    if not box.is_bounded("both"):
        raise ValueError(
            f"The action space must be bounded, got {box}. Say which actions are sensible, here those from -1 to 1, or "
            "2 beyond the only bound: "
            "gymnasium.wrappers.TransformAction(env, lambda a: a, gymnasium.spaces.Box("
            "np.where(env.action_space.bounded_below, env.action_space.low, np.fmin(env.action_space.high, 1) - 2), "
            "np.where(env.action_space.bounded_above, env.action_space.high, np.fmax(env.action_space.low, -1) + 2), "
            "dtype=env.action_space.dtype))."
        )


def _as_box(name: str, space: spaces.Space[Any]) -> str:
    """How an environment gets the space that a dynamics model needs."""
    if name == "action" and isinstance(space, spaces.Discrete):
        return (
            "As they are, discrete actions are not supported; give each a preference, the greatest of which counts: "
            "gymnasium.wrappers.TransformAction(env, lambda a: env.action_space.start + int(np.argmax(a)), "
            f"gymnasium.spaces.Box(-1.0, 1.0, ({int(space.n)},)))."
        )
    if name == "action":
        return (
            "gymnasium.wrappers.TransformAction(env, function, space) makes the environment's actions of those of a "
            "one-dimensional Box; discrete actions are not supported as they are."
        )
    return "For a dictionary or an image, use gymnasium.wrappers.FlattenObservation."


def env_id(env: VecEnv) -> str | None:
    """Returns the Gymnasium id of an environment, whatever wraps it; None where it was not registered."""
    spec: EnvSpec | None = env.get_attr("spec")[0]
    return None if spec is None else spec.id


def env_spec(env: VecEnv) -> dict[str, Any] | None:
    """Returns the id, arguments and time limit of an environment as JSON types, if that is all there is to say."""
    spec = plain_spec(env)
    if spec is None:
        return None
    kwargs = {key: as_json(value) for key, value in spec.kwargs.items()}
    try:
        json.dumps(kwargs)
    except TypeError:  # an argument that no file can name
        return None
    return {"id": spec.id, "kwargs": kwargs, "max_episode_steps": spec.max_episode_steps}


ONLOOKERS = frozenset({"Monitor", "RecordEpisodeStatistics", "RecordVideo", "HumanRendering"})
"""Wrappers that change nothing of what a robot and its agent tell each other."""
FAULTS = frozenset({FaultWrapper.class_name()})
"""What it changes is inside the robot: an observation means the same, be it wrong or not."""


def as_json(value: Any) -> Any:
    """Turns an argument into JSON types, where it is one of ours, a number, an array, or made of these."""
    if isinstance(value, Situation):
        return as_json(value.to_dict())
    if isinstance(value, Profile):
        return as_json(asdict(value))
    if isinstance(value, Mapping):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [as_json(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value  # numpy's and torch's numbers and arrays


def different_arguments(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Names the arguments by which two descriptions of one environment differ; what is not named has its default.

    Args:
        one: As of :func:`env_spec`.
        other: The same, with the same id.
    """
    spec = gym.registry.get(one["id"])
    defaults = {} if spec is None else default_arguments(spec)
    first, second = ({**defaults, **described["kwargs"]} for described in (one, other))
    missing = object()
    names = first.keys() | second.keys()
    return sorted(name for name in names if first.get(name, missing) != second.get(name, missing))


def default_arguments(spec: EnvSpec) -> dict[str, Any]:
    """Returns the arguments that an environment has where nobody gives any, as JSON types."""
    try:
        make = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
        parameters = inspect.signature(make).parameters.values() if make is not None else ()
    except (AttributeError, ImportError, TypeError, ValueError):  # of code that says nothing of itself
        parameters = ()
    named = {item.name: item.default for item in parameters if item.default is not inspect.Parameter.empty}
    return {name: as_json(value) for name, value in {**named, **spec.kwargs}.items()}


def plain_spec(env: VecEnv, wrappers: frozenset[str] = ONLOOKERS) -> EnvSpec | None:
    """Returns the spec of a registered environment that has no other wrappers than these, which only look on."""
    spec: EnvSpec | None = env.get_attr("spec")[0]
    if spec is None or not wrappers.issuperset(wrapper.name for wrapper in spec.additional_wrappers):
        return None
    return None if any(layer.change for layer in vector_layers(env)) else spec


def env_attribute(env: VecEnv, name: str, default: Any) -> Any:
    """Returns an attribute of the first environment."""
    return env.get_attr(name)[0] if env.has_attr(name) else default


def first_env(env: VecEnv) -> gym.Env[Any, Any] | EnvSpec | None:
    """Returns the first environment, or where that is in another process what it was made of."""
    here: list[gym.Env[Any, Any]] = getattr(env.unwrapped, "envs", [])
    spec: EnvSpec | None = None if here else env.get_attr("spec")[0]
    return here[0] if here else spec


def special_dims(
    env: VecEnv, given: Mapping[str, Sequence[int] | None], egocentric: bool, raw_angles: bool
) -> dict[str, tuple[int, ...]]:
    """Returns the special dimensions of an observation by name: those that were given, else the environment's.

    Args:
        env: The environment.
        given: What the user says of ``angle_dims``, ``quaternion_dims`` and ``pose_dims``; None asks the environment.
        egocentric: Whether a pose on a floor counts as one.
        raw_angles: Whether the environment's angles count as plain numbers.

    Raises:
        ValueError: A wrapper changes the observations that the environment speaks of.
    """
    known = {name: tuple(env_attribute(env, name, ())) for name in given}
    if not egocentric:
        heading = known["pose_dims"][2:]
        known |= {"pose_dims": (), "angle_dims": known["angle_dims"] + (heading if len(heading) == 1 else ())}
    if raw_angles:
        known |= {"angle_dims": ()}
    for name in (name for name, chosen in given.items() if chosen is None and known[name]):
        if changed := [layer.name for layer in layers(env, name) if layer.change & Change.OBSERVATION]:
            raise ValueError(
                f"The environment's {name} are of what {', '.join(changed)} changes, or may change; give those of the "
                f"wrapped observations ({name}=..., or () for none), or the environment without that wrapper."
            )
    return {name: known[name] if chosen is None else tuple(chosen) for name, chosen in given.items()}
