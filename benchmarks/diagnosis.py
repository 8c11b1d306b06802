"""What a diagnosis is worth: how often the fault that is named is the one that the robot has.

python -m benchmarks.diagnosis                           # our robots
python -m benchmarks.diagnosis --robots halfcheetah pusher

Each robot lives one episode with nothing wrong, with each fault that was trained, with two of them at once, and with
faults of other kinds, for which no name would be right. Our robots walk on held-out dynamics where they have such.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from benchmarks import gym_robots
from benchmarks.methods import famle
from benchmarks.results import Result, load
from benchmarks.runner import Batch, Execution, launch, run_batches
from benchmarks.task import Task
from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.adaptation.diagnosis import STRANGE
from famle_envs import Situation
from famle_envs.ant import AntEnv
from famle_envs.minitaur import MinitaurEnv
from famle_envs.quadruped import QuadrupedEnv
from famle_envs.reacher import ReacherEnv
from famle_envs.robot_env import RobotEnv

AT = (10, 25, 50, 100, 250, 500)
"""Steps after which the diagnosis is noted; and after the last one."""

SURE = 0.9
INTACT = 5  # episodes of the intact robot

OURS: Mapping[str, tuple[type[RobotEnv], Sequence[str], str]] = {
    "reacher": (ReacherEnv, ("joint 1 locked", "joint 0 sensor off by 0.5 rad", "joint 2 at gain 0.4"), ""),
    "ant": (AntEnv, ("friction x 0.25", "joint 4 locked", "joint 1 at gain -0.8"), ""),
    "quadruped": (QuadrupedEnv, ("friction x 0.3",), "held-out"),
    "minitaur": (MinitaurEnv, (), "held-out"),
}
"""Class, faults of other kinds than those trained, and the profile of the test robot."""


@dataclass(frozen=True)
class Args(Execution):
    """What a diagnosis is worth."""

    robots: tuple[str, ...] = tuple(OURS)
    """Our robots, and beds of benchmarks.gym_robots."""
    steps: int = 500
    """Of an episode at most."""


@dataclass(frozen=True)
class Case:
    """A robot and what would be right to say of it.

    Attributes:
        fault: What is wrong.
        parts: The single faults that it consists of; None where it is of another kind than was trained.
        make: Makes the robot.
    """

    fault: str
    parts: frozenset[Situation | str] | None
    make: Callable[[], gym.Env[Any, Any]]


def parts_of(label: str) -> frozenset[Situation | str]:
    """Takes a label apart into single faults: ``"a + b, c"`` is all three at once, and ``"intact"`` is none."""
    return frozenset(map(_fault, label.replace(" + ", ", ").split(", "))) - {Situation()}


def _fault(clause: str) -> Situation | str:
    """Reads a fault, which may be written in several ways; what only its bed can read stays as it is."""
    try:
        fault = Situation.from_string(clause)
    except ValueError:
        return clause
    return replace(fault, orientation_error=round(fault.orientation_error, 6))


def ours(robot: str, steps: int) -> Iterator[Case]:
    """Describes the cases of one of our robots."""
    kind, strange, profile = OURS[robot]
    trained = [str(situation) for situation in kind.training_situations]
    env_id = Task(robot, 0, Situation(), Path()).env_id
    settings: dict[str, Any] = {"engine": Task.engine} | ({"profile": profile} if profile else {})

    def case(fault: str, known: bool = True) -> Case:
        make = partial(gym.make, env_id, situation=fault, max_episode_steps=steps, **settings)
        return Case(fault, parts_of(fault) if known else None, make)

    for fault in ("intact",) * INTACT + tuple(trained[1:]):
        yield case(fault)
    half = len(trained) // 2
    for one, other in zip(trained[1:half], trained[half + 2 :], strict=False):
        if parts_of(one).isdisjoint(parts_of(other)) and _is_possible(f"{one}, {other}"):
            yield case(f"{one}, {other}")
    for fault in strange:
        yield case(fault, known=False)


def _is_possible(fault: str) -> bool:
    """Tells whether a description does not contradict itself."""
    try:
        Situation.from_string(fault)
    except ValueError:
        return False
    return True


def bed(name: str) -> Iterator[Case]:
    """Describes the cases of one of Gymnasium's robots."""
    robots = gym_robots.BEDS[name]()
    intact, *trained = robots.train
    known = frozenset[Situation | str]().union(*map(parts_of, trained))
    for label in (intact,) * INTACT + tuple(trained):
        yield Case(label, parts_of(label), robots.train[label])
    for label, make in robots.test.items():
        yield Case(label, parts_of(label) if parts_of(label) <= known else None, make)


def agent_of(robot: str, cache: Path) -> FAMLE:
    """Makes FAMLE with its default settings; what it meta-learns is kept."""
    if robot in OURS:
        return famle(Task(robot, 0, Situation(), cache))
    agent = gym_robots.agent_of("famle", robot, 0, cache, ())
    if not isinstance(agent, FAMLE):
        raise TypeError(f"FAMLE's agent is a {type(agent).__name__}.")
    return agent


def run(robot: str, number: int, args: Args) -> list[Result]:
    """Runs one case, and notes what is said of it on the way."""
    case = list(ours(robot, args.steps) if robot in OURS else bed(robot))[number]
    agent = agent_of(robot, args.cache)
    agent.set_random_seed(number)
    env = FAMLEWrapper(case.make(), agent)
    obs, _ = env.reset(seed=number)
    said, total, step, ended = list[dict[str, Any]](), 0.0, 0, False
    while not ended:
        obs, reward, terminated, truncated, _ = env.step(agent.predict(obs)[0])
        step, total, ended = step + 1, total + float(reward), terminated or truncated or step + 1 == args.steps
        if step in AT or ended:
            found = agent.diagnose()
            right = parts_of(found.situation) == case.parts
            probability, error = round(found.probability, 4), round(min(found.error, 1e6), 3)
            said.append(
                {"step": step, "named": found.situation, "probability": probability, "error": error, "right": right}
            )
    env.close()
    return [{"fault": case.fault, "known": case.parts is not None, "said": said, "return": round(total, 2)}]


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Says for each robot how far its diagnoses can be believed."""
    rows = {}
    for robot, table in results.groupby("method"):
        said = [
            one | {"known": known} for known, saids in zip(table["known"], table["said"], strict=True) for one in saids
        ]
        known = [one for one in said if one["known"]]
        sure = [one["right"] for one in known if one["probability"] >= SURE]
        intact = table[table["fault"] == table["fault"].iloc[0]]["said"]
        broken = [any(one["probability"] >= SURE and not one["right"] for one in saids) for saids in intact]
        rows[robot] = {
            "named right": _mean([one["right"] for one in known]),
            "sure": _mean([one["probability"] >= SURE for one in known]),
            "right of the sure": _mean(sure),
            "intact called broken": _mean(broken),
            "unlike all, known faults": _mean([_is_strange(saids) for saids in table[table["known"]]["said"]]),
            "unlike all, other kinds": _mean([_is_strange(saids) for saids in table[~table["known"]]["said"]]),
        }
    return pd.DataFrame(rows).T


def _is_strange(said: Sequence[Mapping[str, Any]]) -> bool:
    """Tells whether a robot is called unlike anything that was trained in the end."""
    return bool(said[-1]["error"] >= STRANGE)


def _mean(values: Sequence[bool]) -> float:
    return sum(values) / len(values) if values else math.nan


def main(args: Args) -> None:
    """Runs what is not stored, and prints what diagnoses are worth."""
    table = args.out / "diagnosis.csv"
    for robot in args.robots:
        cases = list(ours(robot, args.steps) if robot in OURS else bed(robot))
        agent_of(robot, args.cache)
        batches = [Batch(robot, (i,), partial(run, robot, i, args)) for i in range(len(cases))]
        run_batches(batches, table, args.jobs, args.backend)
    print(summary(load(table)).round(2).to_string())


if __name__ == "__main__":
    launch(main, Args)
