"""The quadruped and the A1 on held-out dynamics: the paper's table I.

python -m benchmarks.quadruped                                     # yaw error, blocked leg, both, yaw error on the way
python -m benchmarks.quadruped --robot a1 --experiments leg both    # the same of the A1
python -m benchmarks.quadruped --experiments gap-home gap-held-out  # what one simulator alone teaches

Replicates share the shipped model, and the other agents theirs; each has its own seed of the robot and the planner, and
legs take turns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from benchmarks.methods import METHODS, Method, about, model_based
from benchmarks.results import Result
from benchmarks.runner import Options, launch, run_experiment
from benchmarks.task import Task
from famle_agent import FAMLEWrapper
from famle_agent.rollout import rollout
from famle_envs import Situation
from famle_envs.goal_walker import LEGS, blocked_leg
from famle_envs.quadruped import HELD_OUT

YAW = math.radians(30)


@dataclass(frozen=True)
class Args(Options):
    """The quadruped and the A1 on held-out dynamics: the paper's table I."""

    robot: Literal["quadruped", "a1"] = "quadruped"
    """Which of them; the report has sections for leg and both of the A1."""
    experiments: tuple[str, ...] = ("yaw", "leg", "both", "later")
    """Some of yaw, leg, both, later, and gap-home, gap-held-out for the intact robot in both."""
    replicates: int = 12
    """Seeds 0, 1, ..."""


def task_of(experiment: str, seed: int, args: Args) -> Task:
    """Makes the test robot of a replicate."""
    leg = blocked_leg(seed % len(LEGS))
    wrong = {
        "yaw": Situation(orientation_error=YAW),
        "leg": Situation(locked_joints=leg.locked_joints),
        "both": Situation(locked_joints=leg.locked_joints, orientation_error=YAW),
    }
    profile = "simulator" if experiment == "gap-home" else HELD_OUT.name
    task = Task(args.robot, seed, wrong.get(experiment, Situation()), args.cache, profile)
    return replace(task, later=wrong["yaw"], strikes_at=5) if experiment == "later" else task


def run(method: str, tasks: Sequence[Task], known: Mapping[str, Method] = METHODS) -> list[Result]:
    """Runs an episode of one test robot that walks by gaits."""
    (task,) = tasks
    agent = model_based(known[method], task)
    env = FAMLEWrapper(task.make(), agent)
    walk = rollout(env, task.seed, task.later, None if task.later is None else task.strikes_at)
    profile = str(env.get_wrapper_attr("profile"))
    env.close()
    result: Result = {
        "situation": str(task.situation),
        "later": None if task.later is None else str(task.later),
        "profile": profile,
        "gaits": walk.steps,
        "reached": walk.success,
        "fell": walk.fell,
        "distance": round(float(walk.position[-1, 0]), 3),
        "believed": walk.situations[-1],
        "path": np.round(walk.position, 3).tolist(),
        "ms_per_plan": round(1e3 * float(np.median(walk.plan_seconds)), 1),
    }
    return [result | about(agent)]


def main(args: Args) -> None:
    """Runs and reports."""
    for experiment in args.experiments:
        tasks = [task_of(experiment, seed, args) for seed in range(args.replicates)]
        run_experiment(f"{args.robot}-{experiment}", tasks, run, args)


if __name__ == "__main__":
    launch(main, Args)
