"""What a control step of each method costs, and what its parts cost beside the raw cost of the same work.

python -m benchmarks.timing                                # all parts, on the arm and the ant
python -m benchmarks.timing --robots ant --parts control   # a whole control step of FAMLE, in an episode
python -m benchmarks.timing --robots ant --parts logging   # what TensorBoard takes of it
python -m benchmarks.timing --robots reacher ant quadruped minitaur --parts engines   # PyBullet beside MuJoCo

Whatever is compared takes turns in one run, so that a slow moment of the machine meets all of it. In "step in turns"
networks are hardly trained, since a step costs the same whatever they know; `famle-original` is measured inside an
episode, without its adaptation at the end, which grows with the number of episodes.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, configure

from benchmarks.methods import famle
from benchmarks.ppo import from_scratch
from benchmarks.reporting.study import ROBOT_ALONE, STEPS_IN_TURNS
from benchmarks.results import provenance, store
from benchmarks.runner import launch
from benchmarks.task import Task
from famle_agent import AMPC, AMPCMAML, FAMLE, AdaptationLog, FAMLEWrapper, ModelBasedAgent
from famle_agent.agents.presets import known_robots
from famle_agent.planning import RandomShooting
from famle_agent.rollout import rollout
from famle_envs import Situation
from famle_envs.engines import ENGINES

HARDLY_TRAINED: Mapping[str, Any] = {
    "rounds": 0,
    "transitions_per_situation": 200,
    "pretrained": False,
    "device": "cpu",
    "seed": 0,
}
"""Settings of an agent that is as slow as a trained one."""

HARDLY: Mapping[str, Any] = {**HARDLY_TRAINED, "joint_iterations": 1, "meta_iterations": 1}
"""The same for those that learn in simulation."""

BREAKS: Mapping[str, str] = {
    "reacher": "paper",
    "ant": "joint 2 dead, yaw sensor off by 60 deg",
    "quadruped": "front left leg blocked",
    "minitaur": "intact",
}
"""What happens to each robot in an episode."""


@dataclass(frozen=True)
class Args:
    """Times control steps and their parts."""

    robots: tuple[str, ...] = ("reacher", "ant")
    """Robots with all modes."""
    parts: tuple[str, ...] = ("step in turns", "environment", "planning", "control", "logging", "engines")
    """What is timed; all but "engines" in PyBullet."""
    turns: int = 5
    """Turns of each method; the median counts."""
    turn_steps: int = 50
    """Robot steps of a turn, half as many of methods that judge 10,000 candidates: these adapt once in so many."""
    repeats: int = 30
    """Timings of each other figure; the median counts."""
    steps: int = 1000
    """Control steps of the episode."""
    threads: int = 1
    """Threads of torch."""
    cache: Path = Path("runs/agents")
    """Folder of the agents that are learnt in simulation."""
    out: Path = Path("benchmarks/results")
    """Folder of timing.csv."""

    def __post_init__(self) -> None:
        for name, known in ((self.robots, BREAKS), (self.parts, PARTS)):
            if unknown := set(name) - set(known):
                raise ValueError(f"There is nothing to time of {', '.join(unknown)}. Known: {', '.join(known)}.")


def in_turns(robot: str, args: Args) -> dict[str, list[float]]:
    """Times control steps of all methods, adaptation or learning and the robot included; ms a step in each turn."""
    agents = _hardly_trained(robot)
    env = _make(robot)
    turns: dict[str, list[float]] = {name: [] for name in (ROBOT_ALONE, *agents)}
    for _ in range(args.turns):
        turns[ROBOT_ALONE].append(_robot_alone(env, args.turn_steps))
        for name, agent in agents.items():
            slow = isinstance(agent, ModelBasedAgent) and isinstance(agent.config.planner, RandomShooting)
            steps = args.turn_steps // 2 if slow else args.turn_steps
            # A turn of PPO is one rollout, and the learning from it.
            steps, before = agent.n_steps if isinstance(agent, PPO) else steps, agent.num_timesteps
            start = time.perf_counter()
            agent.learn(steps, reset_num_timesteps=False)
            turns[name].append(1e3 * (time.perf_counter() - start) / (agent.num_timesteps - before))
    return turns


def environment(robot: str, args: Args) -> dict[str, float]:
    """Times a step of the environment against the bare calls of its simulator."""
    env: Any = _make(robot).unwrapped
    action = np.full(env.action_space.shape, 0.3)

    def bare() -> None:
        env.world.simulate(env.physics_steps)

    step, raw = _medians(10 * args.repeats, lambda: env.step(action), bare)
    env.close()
    return {"environment step (ms)": step, "bare stepSimulation (ms)": raw, "ratio": step / raw}


def engines(robot: str, args: Args) -> dict[str, float]:
    """Times a step of the environment in each engine, and a second of its own time; of the processor alone."""
    envs = [_make(robot, engine=engine) for engine in ENGINES]
    action = np.full(envs[0].action_space.shape or (), 0.3)
    # The clock leaves out what other processes take of the long steps of gaits.
    steps = _medians(args.repeats, *(partial(env.unwrapped.step, action) for env in envs), clock=time.process_time)
    period = envs[0].get_wrapper_attr("control_period")
    for env in envs:
        env.close()
    figures = dict[str, float]()
    for engine, step in zip(ENGINES, steps, strict=True):
        figures |= {f"{engine}: step (ms)": step, f"{engine}: simulated second (ms)": step / period}
    return figures


def planning(robot: str, args: Args) -> dict[str, float]:
    """Times our plan, and the paper's against the bare matrix products of the same shapes."""
    task = Task(robot, 0, Situation(), args.cache)
    ours, paper = famle(task), FAMLE(task.simulated(), "paper", **HARDLY).meta_learn()
    planner, model, obs = paper.config.planner, paper.model, _make(robot).reset(seed=0)[0]
    sizes = [model.n_features + model.action_dim, *paper.config.model.hidden, model.obs_dim]
    x = [torch.randn(planner.candidates, size) for size in sizes[:-1]]
    weights = [torch.randn(a, b) for a, b in pairwise(sizes)]

    def bare() -> None:
        for _ in range(planner.horizon):
            for rows, weight in zip(x, weights, strict=True):
                torch.mm(rows, weight)

    repeats = max(3, args.repeats // 5)
    plan, shooting, raw = _medians(repeats, lambda: ours.predict(obs), lambda: paper.predict(obs), bare)
    return {
        "our plan (ms)": plan,
        "the paper's plan (ms)": shooting,
        "bare products (ms)": raw,
        "ratio of the paper's and bare": shooting / raw,
        "ratio of the paper's and ours": shooting / plan,
    }


def control(robot: str, args: Args) -> dict[str, float]:
    """Times whole control steps on a robot that breaks after a third of an episode: plan, adaptation and simulation."""
    agent = famle(Task(robot, 0, Situation(), args.cache))
    env = FAMLEWrapper(_make(robot, max_episode_steps=args.steps), agent)
    milliseconds = 1e3 * rollout(env, 0, BREAKS[robot], args.steps // 3).step_seconds[10:]
    period = 1e3 * env.get_wrapper_attr("control_period")
    env.close()
    return {
        "mean (ms)": float(milliseconds.mean()),
        "median (ms)": float(np.median(milliseconds)),
        "99th percentile (ms)": float(np.percentile(milliseconds, 99)),
        "control period (ms)": period,
        "within the period": float((milliseconds <= period).mean()),
    }


class _TimedLog(AdaptationLog):
    """Takes the time of each step's entry in TensorBoard, in s."""

    def __init__(self, agent: ModelBasedAgent, logger: Logger) -> None:
        super().__init__(agent, logger)
        self.seconds = list[float]()

    def step(self, *args: Any) -> None:
        start = time.perf_counter()
        super().step(*args)
        self.seconds.append(time.perf_counter() - start)


def logging(robot: str, args: Args) -> dict[str, float]:
    """Times what TensorBoard takes of the control steps of such an episode."""
    agent = famle(Task(robot, 0, Situation(), args.cache))
    with tempfile.TemporaryDirectory() as folder:
        logger = configure(folder, ["tensorboard"])
        log = _TimedLog(agent, logger)
        env = FAMLEWrapper(_make(robot, max_episode_steps=args.steps), agent, log)
        total = rollout(env, 0, BREAKS[robot], args.steps // 3).step_seconds  # entries included
        logger.close()
        env.env.close()
    taken = np.array(log.seconds)
    return {
        "control step without entries (ms)": 1e3 * float((total - taken).mean()),
        "entries, mean of all steps (ms)": 1e3 * float(taken.mean()),
        "longest entry (ms)": 1e3 * float(taken.max()),
        "share of entries": float(taken.sum() / (total - taken).sum()),
    }


PARTS: Mapping[str, Callable[[str, Args], Mapping[str, Any]]] = {
    STEPS_IN_TURNS: in_turns,
    "environment": environment,
    "planning": planning,
    "control": control,
    "logging": logging,
    "engines": engines,
}
"""What can be timed."""


def main(args: Args) -> None:
    """Measures, stores and prints."""
    torch.set_num_threads(args.threads)
    for robot in args.robots:
        for part in args.parts:
            figures = PARTS[part](robot, args)
            about = {"robot": robot, "part": part, "threads": args.threads} | provenance(sys.argv)
            rows = [{"figure": figure, "value": value} | about for figure, value in figures.items()]
            store(args.out / "timing.csv", rows, keys=("robot", "part", "threads"))
            medians = pd.Series({figure: np.median(value) for figure, value in figures.items()}, name=part)
            print(f"\n{robot}, {part}, {args.threads} thread(s), medians:", medians.to_string(), sep="\n")


def _medians(repeats: int, *calls: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> list[float]:
    """Returns the median milliseconds of calls that take turns; the first two turns only warm up."""
    seconds = np.zeros((repeats + 2, len(calls)))
    for turn in range(len(seconds)):
        for i, call in enumerate(calls):
            start = clock()
            call()
            seconds[turn, i] = clock() - start
    return [float(median) for median in 1e3 * np.median(seconds[2:], axis=0)]


def _make(robot: str, engine: str = Task.engine, **kwargs: Any) -> gym.Env[Any, Any]:
    env = gym.make(known_robots()[robot].env_id, engine=engine, **kwargs)
    env.reset(seed=0)
    return env


def _hardly_trained(robot: str) -> dict[str, BaseAlgorithm]:
    task = Task(robot, 0, Situation(), Path())
    agents: dict[str, BaseAlgorithm] = {
        "famle": FAMLE(task.simulated(), **HARDLY),
        "famle-paper": FAMLE(task.simulated(), "paper", **HARDLY),
        "famle-original": FAMLE(task.simulated(), "original", **HARDLY),
        "ampc": AMPC(task.simulated(), **HARDLY_TRAINED),
        "ampc-reptile": AMPCMAML(task.simulated(), **HARDLY),
        "ampc-fomaml": AMPCMAML(task.simulated(), meta_learner="first-order-maml", **HARDLY),
        "ampc-maml": AMPCMAML(task.simulated(), meta_learner="maml", **HARDLY),
        "ppo": from_scratch(task),
    }
    for agent in agents.values():
        if isinstance(agent, ModelBasedAgent):
            agent.meta_learn()
    return agents


def _robot_alone(env: gym.Env[Any, Any], steps: int) -> float:
    """Returns the mean milliseconds of a step with random actions."""
    env.reset()
    start = time.perf_counter()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    return 1e3 * (time.perf_counter() - start) / steps


if __name__ == "__main__":
    launch(main, Args)
