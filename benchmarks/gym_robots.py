"""Gymnasium's robots with faults that nobody has seen, and no setting changed for any of them.

python -m benchmarks.gym_robots                               # all beds, three meta-trainings each
python -m benchmarks.gym_robots --beds halfcheetah --seeds 5

The beds are those of the field (GrBAL: Nagabandi et al., 2019; CaDM: Lee et al., 2020; T-MCL: Seo et al., 2020), with
the faults of motors for the others. Each robot lives one episode, its first.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from benchmarks.methods import from_cache
from benchmarks.model_free import MODEL_FREE, Policy, as_policy
from benchmarks.results import Result, load
from benchmarks.runner import Batch, Execution, launch, run_batches
from famle_agent import AMPC, AMPCMAML, FAMLE, FAMLEWrapper, ModelBasedAgent
from famle_agent.training.policy_search import PolicySearch
from famle_envs.faults import FaultWrapper

Env = gym.Env[Any, Any]
Make = Callable[[], Env]


def faulty(env_id: str, situation: str, steps: int, **kwargs: Any) -> gym.Env[Any, Any]:
    """Makes a robot that is broken."""
    return FaultWrapper(gym.make(env_id, max_episode_steps=steps, **kwargs), situation)


class Hanging(gym.Wrapper[Any, Any, Any, Any]):
    """A pendulum of another mass and length, which begins at rest below, as CaDM has it."""

    def __init__(self, mass: float, length: float) -> None:
        super().__init__(gym.make("Pendulum-v1"))
        self.unwrapped.m, self.unwrapped.l = mass, length  # type: ignore[attr-defined]

    def reset(self, **kwargs: Any) -> Any:
        """Resets it to where it hangs."""
        _, info = self.env.reset(**kwargs)
        self.unwrapped.state = np.array([np.pi, 0.0])  # type: ignore[attr-defined]
        return np.array([-1.0, 0.0, 0.0], dtype=np.float32), info


@dataclass(frozen=True)
class Bed:
    """A robot, what is wrong with it in training, and what nobody has told it.

    Attributes:
        train: Environments by situation, the intact one first.
        test: Environments of unseen robots.
    """

    train: Mapping[str, Make]
    test: Mapping[str, Make]


def faults_of(env_id: str, steps: int, train: tuple[str, ...], test: tuple[str, ...], **kwargs: Any) -> Bed:
    """Describes a bed of faults by their names."""
    make = {name: partial(faulty, env_id, name, steps, **kwargs) for name in ("intact", *train, *test)}
    return Bed({name: make[name] for name in ("intact", *train)}, {name: make[name] for name in test})


def every_motor(n: int, fault: str) -> tuple[str, ...]:
    """Names one fault of each motor."""
    return tuple(f"motor {i} {fault}" for i in range(n))


def pendulum() -> Bed:
    """Describes CaDM's: mass and length out of range."""
    train = {f"mass {m}, length {x}": partial(Hanging, m, x) for m, x in product((1.0, 0.75, 1.25), repeat=2)}
    train = {"intact": train.pop("mass 1.0, length 1.0"), **train}
    unseen = ((0.3, 1.7), (0.6, 1.4), (1.4, 0.6), (1.7, 0.3))
    return Bed(train, {f"mass {m}, length {x}": partial(Hanging, m, x) for m, x in unseen})


def masses_and_dampings() -> Bed:
    """Describes CaDM's half cheetah: mass and damping out of range, and the intact robot to compare with."""
    train = [f"mass x {m}, damping x {d}" for m, d in product((1.0, 0.75, 0.85, 1.15, 1.25), repeat=2)]
    test = [f"mass x {x}, damping x {x}" for x in (0.25, 0.45, 1.55, 1.75)]
    bed = faults_of("HalfCheetah-v5", 500, tuple(train[1:]), tuple(test))  # the first is the intact robot
    return Bed(bed.train, {"intact": bed.train["intact"], **bed.test})


BEDS: Mapping[str, Callable[[], Bed]] = {
    "halfcheetah": lambda: faults_of(
        "HalfCheetah-v5",
        500,
        every_motor(4, "dead"),
        ("motor 4 dead", "motor 5 dead", "motor 0 dead, motor 4 dead", "motor 1 dead, motor 3 dead"),
    ),
    "halfcheetah-body": masses_and_dampings,
    "ant": lambda: faults_of(
        "Ant-v5",
        500,
        tuple(f"motor {2 * i} dead, motor {2 * i + 1} dead" for i in range(3)),
        ("motor 6 dead, motor 7 dead",),
        include_cfrc_ext_in_observation=False,
    ),
    "invertedpendulum": lambda: faults_of(
        "InvertedPendulum-v5",
        1000,
        (*(f"motor 0 strength x {f}, body 1 mass x {m}" for f in (0.5, 1.5) for m in (0.8, 1.2)), "motor 0 reversed"),
        (
            "motor 0 strength x 0.25, body 1 mass x 0.35",
            "motor 0 strength x 1.75, body 1 mass x 1.6",
            "motor 0 at gain -0.8, body 1 mass x 1.1",
        ),
    ),
    "pendulum": pendulum,
    "pusher": lambda: faults_of(
        "Pusher-v5",
        100,
        every_motor(7, "dead") + every_motor(7, "reversed"),
        (
            "motor 0 reversed, motor 3 dead",
            "motor 1 at gain 0.3, motor 5 reversed",
            "motor 0 reversed, motor 3 reversed",
        ),
    ),
    "reacher": lambda: faults_of(
        "Reacher-v5",
        50,
        every_motor(2, "dead") + every_motor(2, "reversed"),
        ("motor 0 at gain 0.3", "motor 0 reversed, motor 1 reversed", "motor 0 at gain -0.5, motor 1 at gain 0.5"),
    ),
    "hopper": lambda: faults_of(
        "Hopper-v5",
        500,
        every_motor(3, "at gain 0.5") + every_motor(3, "dead"),
        ("motor 0 at gain 0.3", "motor 1 at gain 0.3", "motor 2 at gain 0.3"),
    ),
    "walker2d": lambda: faults_of(
        "Walker2d-v5",
        500,
        every_motor(6, "dead"),
        ("motor 0 at gain 0.3", "motor 4 at gain 0.3", "motor 2 dead, motor 5 dead"),
    ),
}
"""Test beds by name."""


METHODS = (
    *("famle", "famle-frozen", "famle-unguided", "famle-actor"),
    *("sac", "ppo", "sac-intact", "ppo-intact"),
    *("ampc-reptile", "ampc", "nothing", "random"),
)
"""FAMLE, without adaptation, without its policy, its policy alone; what learns no model; the rivals; neither."""

LONG = ("sac-10x", "ppo-10x")
"""What takes an hour and more of each bed, and runs where it is asked for."""


@dataclass(frozen=True)
class Args(Execution):
    """Robots of Gymnasium with faults that nobody has seen."""

    beds: tuple[str, ...] = tuple(BEDS)
    """Test beds."""
    methods: tuple[str, ...] = METHODS
    """What is compared; FAMLE first, whose meta-training the others share."""
    seeds: int = 3
    """Independent meta-trainings."""
    lives: int = 3
    """First episodes of each unseen robot, which begin from different places."""
    change: tuple[str, ...] = ()
    """Settings of FAMLE to change, such as policy_steps=100000; the table gets them into its name."""

    def __post_init__(self) -> None:
        for names, known in ((self.beds, tuple(BEDS)), (self.methods, METHODS + LONG)):
            if unknown := set(names) - set(known):
                raise ValueError(f"There is no {', '.join(unknown)}. Known: {', '.join(known)}.")


class Actor:
    """Chooses actions on a robot by its observations: at random, unless a subclass does better."""

    def begin(self, env: Env) -> Env:
        """Takes over a new robot, whose actions it is to choose."""
        self.space: Any = env.action_space
        return env

    def __call__(self, obs: Any) -> Any:
        """Chooses an action."""
        return self.space.sample()


class Nothing(Actor):
    """Does nothing."""

    def __call__(self, obs: Any) -> Any:
        """Chooses 0."""
        return np.zeros(self.space.shape, self.space.dtype)


class Planner(Actor):
    """One of our agents, which knows nothing of the last robot."""

    def __init__(self, agent: ModelBasedAgent) -> None:
        self.agent = agent

    def begin(self, env: Env) -> Env:
        """Takes over a new robot, and watches it."""
        self.agent.forget()
        self.agent.set_random_seed(0)
        return FAMLEWrapper(env, self.agent)

    def __call__(self, obs: Any) -> Any:
        """Plans."""
        return self.agent.predict(obs)[0]


class Learnt(Actor):
    """A policy that is told nothing of the situation."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    def __call__(self, obs: Any) -> Any:
        """Does as it has learnt."""
        return self.policy(obs)


def kind_of(method: str) -> type[ModelBasedAgent]:
    """Returns the class of a method's agent."""
    return {"ampc": AMPC, "ampc-reptile": AMPCMAML}.get(method, FAMLE)


def cached_at(method: str, name: str, seed: int, cache: Path, change: tuple[str, ...]) -> Path:
    """Returns where what a method meta-learns is kept, which FAMLE and its variants share."""
    return cache / f"gym-{'-'.join((name, kind_of(method).__name__, *change))}-{seed}.zip"


def settings_of(change: tuple[str, ...]) -> dict[str, Any]:
    """Reads settings that are to be changed, as ``"policy_steps=100000"``."""
    return {key: json.loads(value) for key, _, value in (one.partition("=") for one in change)}


def agent_of(method: str, name: str, seed: int, cache: Path, change: tuple[str, ...]) -> ModelBasedAgent:
    """Makes an agent with nothing changed but what its name says; what it meta-learns is kept."""
    train = BEDS[name]().train
    make = kind_of(method)
    settings = settings_of(change) if make is FAMLE else {}
    agent = make(train["intact"](), seed=seed, device="cpu", **settings)
    path = cached_at(method, name, seed, cache, change)
    agent = from_cache(agent, path, lambda agent: agent.meta_learn(train))
    if method == "famle-frozen":
        agent.config = agent.config.changed(adapt_every=0)
    if method == "famle-unguided" and agent.policy.world is not None:
        agent.policy.world = replace(agent.policy.world, actor_critic=None)
    return agent


def is_learnt(method: str, name: str, seed: int, cache: Path, change: tuple[str, ...]) -> bool:
    """Tells whether what a method meta-learns is in the cache, so that nothing can be said of the time it takes."""
    return method not in (*MODEL_FREE, "nothing", "random") and cached_at(method, name, seed, cache, change).exists()


def actor_of(method: str, name: str, seed: int, cache: Path, change: tuple[str, ...]) -> Actor:
    """Makes what chooses the actions."""
    if method in ("nothing", "random"):
        return Nothing() if method == "nothing" else Actor()
    if method in MODEL_FREE:
        train = BEDS[name]().train
        settings = FAMLE(train["intact"](), **settings_of(change)).config.simulation.policy or PolicySearch()
        return Learnt(MODEL_FREE[method].learn(train, settings, seed))
    agent = agent_of(method, name, seed, cache, change)
    if method != "famle-actor":
        return Planner(agent)
    world = agent.policy.world
    if world is None or world.actor_critic is None:
        raise ValueError("This agent has learnt no policy; leave out famle-actor, or give it policy_steps.")
    return Learnt(as_policy(world.actor_critic, agent.action_space))


def rollout(env: Env, actor: Actor, seed: int) -> tuple[float, list[float]]:
    """Runs the first episode of a robot; returns its return, and the seconds that each action took to choose."""
    env = actor.begin(env)
    env.action_space.seed(seed)
    (obs, _), total, seconds, ended = env.reset(seed=seed), 0.0, list[float](), False
    while not ended:
        start = time.perf_counter()
        action = actor(obs)
        seconds.append(time.perf_counter() - start)
        obs, reward, terminated, truncated, _ = env.step(action)
        total, ended = total + float(reward), terminated or truncated
    env.close()
    return total, seconds


def run(method: str, name: str, seed: int, lives: int, cache: Path, change: tuple[str, ...]) -> list[Result]:
    """Runs a method of one meta-training on all unseen robots."""
    known, start = is_learnt(method, name, seed, cache, change), time.process_time()
    actor = actor_of(method, name, seed, cache, change)
    learning = None if known else time.process_time() - start
    test, choosing = BEDS[name]().test, list[float]()
    returns, steps = {robot: list[float]() for robot in test}, {robot: list[int]() for robot in test}
    for (robot, make), life in product(test.items(), range(lives)):
        total, seconds = rollout(make(), actor, 1000 + seed + 100 * life)
        returns[robot].append(total)
        steps[robot].append(len(seconds))
        choosing += seconds
    milliseconds = 1e3 * float(np.median(choosing))
    return [{"cpu_seconds": learning, "returns": returns, "steps": steps, "ms_per_step": milliseconds}]


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Counts lives of unseen robots; takes median, worst and best over all, and the median of each robot."""
    table = pd.DataFrame(list(results["returns"]), index=results["method"])
    lives = table.melt(ignore_index=False, var_name="robot", value_name="return").explode("return")
    lives = lives.astype({"return": float})
    methods = [method for method in (*METHODS, *LONG) if method in table.index]
    over_all = lives.groupby(level=0)["return"].agg(["size", "median", "min", "max"]).rename(columns={"size": "lives"})
    of_each = lives.pivot_table("return", index="method", columns="robot", aggfunc="median")[table.columns]
    return over_all.join(of_each).loc[methods]


def main(args: Args) -> None:
    """Runs what is not stored, and prints medians over meta-trainings and unseen robots."""
    for name in args.beds:
        table = args.out / f"gym-{'-'.join((name, *args.change))}.csv"
        for method in args.methods:
            batches = [
                Batch(method, (seed,), partial(run, method, name, seed, args.lives, args.cache, args.change))
                for seed in range(args.seeds)
            ]
            run_batches(batches, table, args.jobs, args.backend)
        print(f"\n{name}: return of the first episode")
        print(summary(load(table)).round(1).to_string())


if __name__ == "__main__":
    launch(main, Args)
