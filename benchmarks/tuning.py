"""One setting of an agent that is meta-trained for the benchmark, at several values, on robots that no result is of.

python -m benchmarks.tuning --robot quadruped --methods ampc-maml --setting inner_lr --values 0.01 0.03 0.1
python -m benchmarks.tuning --robot ant --methods ampc --setting adapt_lr --values 1e-3 3e-3 --replicates 3 --steps 5000

The robots are drawn like those of the tests, with seeds of their own. Prints the mean of each value and its replicates:
gaits to the goal (one more than there are where it is not reached), metres, or the return of an episode.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from benchmarks import ant, curves, quadruped
from benchmarks.methods import META_TRAINED, Method
from benchmarks.reporting.registry import experiment_named
from benchmarks.results import Result, load
from benchmarks.runner import Options, compare, launch
from benchmarks.task import Task
from famle_envs import Situation
from famle_envs.profile import Profile
from famle_envs.quadruped import LEGS, blocked_leg
from famle_envs.reacher import ReacherEnv

YAW = math.radians(40)
RobotName = Literal["reacher", "ant", "quadruped", "minitaur"]
IN_EPISODES = ("reacher", "ant")
"""Robots that go through one episode after the other."""


@dataclass(frozen=True)
class Args(Options):
    """One setting of an agent at several values, on robots that no result is of."""

    robot: RobotName = "quadruped"
    """The robot."""
    methods: tuple[str, ...] = ("ampc-maml",)
    """Entries of benchmarks.methods.META_TRAINED."""
    setting: str = "inner_lr"
    """One of the fields of famle_agent.agents.config.Hyperparameters."""
    values: tuple[str, ...] = ("0.01", "0.03", "0.1")
    """What it is set to, as in JSON."""
    replicates: int = 9
    """Robots 0, 1, ..."""
    steps: int = 500
    """Robot steps of an arm or an ant."""
    out: Path = Path("runs/tuning")
    """Folder of the results."""


def main(args: Args) -> None:
    """Runs and prints.

    Raises:
        ReplicateError: A value failed, as one with which the learning diverges; the others are printed first.
        ValueError: The method is not meta-trained for the benchmark, or a value is not one of JSON.
    """
    tasks = [ROBOTS[args.robot](i, args.cache) for i in range(args.replicates)]
    known = {
        f"{name}-{args.setting}={value}": method_with(name, args.setting, value)
        for name in args.methods
        for value in args.values
    }
    in_episodes = args.robot in IN_EPISODES
    run = partial(_run_episodes, args=args, known=known) if in_episodes else partial(quadruped.run, known=known)
    table = args.out / (f"{args.robot}-{args.steps}.csv" if in_episodes else f"{args.robot}.csv")
    try:
        compare(list(known), tasks, run, table, args, known, together=in_episodes)
    finally:
        results = load(table) if table.exists() else pd.DataFrame(columns=["method"])
        for name in known:
            mine = results[results["method"] == name][: args.replicates]
            if len(scores := mine.apply(score, axis="columns", robot=args.robot)):
                print(f"{args.robot}, {name}: {scores.mean():.1f} of", *(f"{value:.1f}" for value in scores))


def method_with(name: str, setting: str, value: str) -> Method:
    """Makes a method with one setting changed, and a model of its own.

    Args:
        name: Of an agent that is meta-trained for the benchmark.
        setting: One of its hyperparameters.
        value: In JSON.

    Raises:
        ValueError: There is no such agent, or the value is not JSON.
    """
    if name not in META_TRAINED:
        raise ValueError(f"{name!r} is not meta-trained for the benchmark. Those that are: {', '.join(META_TRAINED)}.")
    recipe = META_TRAINED[name]
    settings = {**recipe.settings, setting: json.loads(value)}
    return replace(recipe, name=f"{recipe.name}-{setting}={value}", settings=settings).method()


def score(result: Mapping[str, Any], robot: RobotName) -> float:
    """Computes what a replicate is judged by: its mean return, its gaits to the goal, or how far it walked."""
    if robot in IN_EPISODES:
        return float(np.mean(result["returns"]))
    if robot == "minitaur":
        return float(result["distance"])
    return float(result["gaits"] if result["reached"] else experiment_named("quadruped-yaw").budget + 1)


def _run_episodes(method: str, tasks: Sequence[Task], args: Args, known: Mapping[str, Method]) -> list[Result]:
    return curves.run(known[method].on(tasks), tasks, args.steps, args.minutes)


# --- the robots -------------------------------------------------------------------------------------------------------


def _arm(i: int, cache: Path) -> Task:
    return Task("reacher", i, ReacherEnv.sample_situation(np.random.default_rng([7, i]), n_faults=2), cache)


def _ant(i: int, cache: Path) -> Task:
    return Task("ant", i, ant.damage_of("validation", i), cache)


def _quadruped(i: int, cache: Path) -> Task:
    """A yaw error, a blocked leg and both, on one body after the other."""
    body, wrong = divmod(i, 3)
    locked = blocked_leg(body % len(LEGS)).locked_joints if wrong else ()
    yaw = 0.0 if wrong == 1 else YAW
    u = np.random.default_rng([5, body])
    profile = Profile(
        name=f"drawn {body}",
        motor_strength=u.uniform(0.025, 0.05),
        motor_speed=u.uniform(0.35, 0.7),
        joint_damping=0.02,
        zero_errors=tuple(u.normal(0.0, 0.1, 12)),
        backlash=u.uniform(0.0, 0.04),
        latency=u.uniform(0.0, 0.06),
        base_mass=u.uniform(1.0, 1.5),
        leg_mass=u.uniform(0.9, 1.2),
        floor_friction=u.uniform(0.35, 0.8),
        contact_stiffness=u.uniform(4000.0, 9000.0),
        contact_damping=50.0,
        position_noise=0.01,
        orientation_noise=0.03,
    )
    return Task("quadruped", i, Situation(locked_joints=locked, orientation_error=yaw), cache, profile)


def _minitaur(i: int, cache: Path) -> Task:
    """Intact, each with a body of its own."""
    u = np.random.default_rng([5, i])
    profile = Profile(
        name=f"drawn {i}",
        motor_strength=u.uniform(0.55, 0.9),
        motor_speed=u.uniform(0.7, 1.0),
        joint_damping=0.02,
        zero_errors=tuple(u.normal(0.0, 0.06, 8)),
        backlash=u.uniform(0.0, 0.03),
        latency=u.uniform(0.0, 0.04),
        base_mass=u.uniform(1.0, 1.4),
        leg_mass=u.uniform(0.9, 1.2),
        floor_friction=u.uniform(0.35, 0.8),
        contact_stiffness=u.uniform(8000.0, 15_000.0),
        contact_damping=100.0,
        position_noise=0.01,
        orientation_noise=0.02,
    )
    return Task("minitaur", i, Situation(), cache, profile)


ROBOTS: Mapping[RobotName, Callable[[int, Path], Task]] = {
    "reacher": _arm,
    "ant": _ant,
    "quadruped": _quadruped,
    "minitaur": _minitaur,
}
"""Makes robot i by the robot's name, with a folder of agents."""


if __name__ == "__main__":
    launch(main, Args)
