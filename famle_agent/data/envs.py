"""From whatever a user calls an environment to environments, one per situation."""

from __future__ import annotations

import gc
import inspect
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain, count
from types import FunctionType
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec, load_env_creator
from stable_baselines3.common.vec_env import VecEnv

from famle_agent.data.policies import reward_names
from famle_agent.data.probe import same_reward
from famle_agent.data.transitions import EnvSource, check_names
from famle_agent.data.wrappers import Change, layers, robot_layers, vector_layers
from famle_agent.models.reward import RewardFn, TerminationFn
from famle_envs.faults import FaultWrapper, make_faulty
from famle_envs.profile import Profile
from famle_envs.situation import Situation

__all__ = [
    "ONLOOKERS",
    "EnvLike",
    "SituationEnvs",
    "SituationsLike",
    "check_spaces",
    "different_arguments",
    "env_attribute",
    "env_id",
    "env_spec",
    "first_env",
    "other_reward",
    "planning_reward",
    "planning_termination",
    "situation_envs",
]

EnvLike = gym.Env[Any, Any] | Callable[[], gym.Env[Any, Any]] | Situation | Mapping[str, Any] | str
"""An environment, a factory of one, or the situation of one."""
SituationsLike = Sequence[EnvLike] | Mapping[str, EnvLike]
"""One per situation; the keys of a mapping are the names of the situations."""


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
    """The Gymnasium id of an environment, whatever wraps it; None where it was not registered."""
    spec: EnvSpec | None = env.get_attr("spec")[0]
    return None if spec is None else spec.id


def env_spec(env: VecEnv) -> dict[str, Any] | None:
    """The Gymnasium id, arguments and time limit of an environment as JSON types, if that is all there is to say."""
    spec = _plain_spec(env)
    if spec is None:
        return None
    kwargs = {key: _plain(value) for key, value in spec.kwargs.items()}
    try:
        json.dumps(kwargs)
    except TypeError:  # an argument that no file can name
        return None
    return {"id": spec.id, "kwargs": kwargs, "max_episode_steps": spec.max_episode_steps}


ONLOOKERS = frozenset({"Monitor", "RecordEpisodeStatistics", "RecordVideo", "HumanRendering"})
"""Wrappers that change nothing of what a robot and its agent tell each other."""
_FAULTS = frozenset({FaultWrapper.class_name()})
"""What it changes is inside the robot: an observation means the same, be it wrong or not."""


def _plain(value: Any) -> Any:
    """An argument as JSON types, where it is one of ours, a number, an array, or made of these."""
    if isinstance(value, Situation):
        return _plain(value.to_dict())
    if isinstance(value, Profile):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value  # numpy's and torch's numbers and arrays


def different_arguments(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """The arguments by which two descriptions of one environment differ; what is not named has its default.

    Args:
        one: As of :func:`env_spec`.
        other: The same, with the same id.
    """
    spec = gym.registry.get(one["id"])
    defaults = {} if spec is None else _defaults(spec)
    first, second = ({**defaults, **described["kwargs"]} for described in (one, other))
    missing = object()
    names = first.keys() | second.keys()
    return sorted(name for name in names if first.get(name, missing) != second.get(name, missing))


def _defaults(spec: EnvSpec) -> dict[str, Any]:
    """The arguments that an environment has where nobody gives any, as JSON types."""
    try:
        make = load_env_creator(spec.entry_point) if isinstance(spec.entry_point, str) else spec.entry_point
        parameters = inspect.signature(make).parameters.values() if make is not None else ()
    except (AttributeError, ImportError, TypeError, ValueError):  # of code that says nothing of itself
        parameters = ()
    named = {item.name: item.default for item in parameters if item.default is not inspect.Parameter.empty}
    return {name: _plain(value) for name, value in {**named, **spec.kwargs}.items()}


def _plain_spec(env: VecEnv, wrappers: frozenset[str] = ONLOOKERS) -> EnvSpec | None:
    """The spec of a registered environment that has no other wrappers than these; by default, that only look on."""
    spec: EnvSpec | None = env.get_attr("spec")[0]
    if spec is None or not wrappers.issuperset(wrapper.name for wrapper in spec.additional_wrappers):
        return None
    return None if any(layer.change for layer in vector_layers(env)) else spec


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
    """One environment per training situation.

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
        spec = _plain_spec(env, ONLOOKERS | _FAULTS)
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


def planning_reward(env: VecEnv, name: str) -> tuple[RewardFn | None, bool]:
    """What a planner should maximise in an environment, where it says that.

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
    """Where episodes end, if an environment says that of what the agent sees.

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
    asked = [{} if spec is None else {**_defaults(spec), **_plain(spec.kwargs)} for spec in specs]
    tasks = [{key: value for key, value in kwargs.items() if key not in _NO_TASK} for kwargs in asked]
    differing = {key for task in tasks for key in task if any(task.get(key) != other.get(key) for other in tasks)}
    return [
        json.dumps({key: task[key] for key in task if key in differing}, default=repr, sort_keys=True) for task in tasks
    ]


_NO_TASK = frozenset({"situation", "profile", "engine", "render_mode"})


def _get(env: gym.Env[Any, Any], name: str, default: Any) -> Any:
    return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else default


def env_attribute(env: VecEnv, name: str, default: Any) -> Any:
    """An attribute of the first environment."""
    return env.get_attr(name)[0] if env.has_attr(name) else default


def first_env(env: VecEnv) -> gym.Env[Any, Any] | EnvSpec | None:
    """The first environment, or where that is in another process what it was made of."""
    here: list[gym.Env[Any, Any]] = getattr(env.unwrapped, "envs", [])
    spec: EnvSpec | None = None if here else env.get_attr("spec")[0]
    return here[0] if here else spec


def special_dims(
    env: VecEnv, given: Mapping[str, Sequence[int] | None], egocentric: bool, raw_angles: bool
) -> dict[str, tuple[int, ...]]:
    """The special dimensions of an observation by name: those that were given, else the environment's.

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
