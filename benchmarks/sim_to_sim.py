"""Agents that are meta-learned in one engine and run in the other.

python -m benchmarks.sim_to_sim                                      # the shipped agents, learnt in PyBullet, in MuJoCo
python -m benchmarks.sim_to_sim --simulator mujoco --robots reacher  # the other way: meta-learns in MuJoCo first

The other engine and the damage are all that is strange to the agent: no profile makes the robot differ further. The
oracle is FAMLE that has learnt in the engine that the robot runs in. "home" is the agent itself in the engine that it
has learnt in, with the same damage, which says whether the robot is as good there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from benchmarks import ant, quadruped, reacher
from benchmarks.methods import METHODS
from benchmarks.reporting.pictures import draw_scores
from benchmarks.reporting.registry import experiment_named, in_order, style_of
from benchmarks.reporting.statistics import gap_closed, interquartile_mean
from benchmarks.results import Result, load
from benchmarks.runner import Options, compare, launch
from benchmarks.task import Engine, Task
from famle_agent.utils.atomic_write import whole_file
from famle_envs import Situation

OTHER: Mapping[Engine, Engine] = {"pybullet": "mujoco", "mujoco": "pybullet"}
NAMES: Mapping[Engine, str] = {"pybullet": "PyBullet", "mujoco": "MuJoCo"}
FROZEN, ORACLE, HOME = "famle-frozen", "oracle", "home"
KNOWN = {**METHODS, ORACLE: METHODS["famle"], HOME: METHODS["famle"]}

_ARM_EPISODE = 50  # steps
_SOLVED = {name: experiment_named(name).threshold for name in ("reacher-random", "ant-unseen")}
_GAITS = experiment_named("quadruped-both").budget


@dataclass(frozen=True)
class Bed:
    """How a robot is tested.

    Attributes:
        label: What a replicate is judged by.
        recovery: When it has recovered.
        situation: Makes what is wrong in a replicate, by its seed.
        run: Runs a method on test robots.
        score: Computes what a replicate is judged by, of its stored row.
        recovered: Whether it has recovered.
    """

    label: str
    recovery: str
    situation: Callable[[int], Situation]
    run: Callable[[str, Sequence[Task]], list[Result]]
    score: Callable[[Any], float]
    recovered: Callable[[Any], bool]


BEDS: Mapping[str, Bed] = {
    "reacher": Bed(
        f"return of the first {_ARM_EPISODE} steps",
        f"above {_SOLVED['reacher-random']:g}",
        partial(reacher.situation_of, "random"),
        partial(reacher.run, args=reacher.Args(steps=_ARM_EPISODE)),
        lambda result: float(result["returns"][0]),
        lambda result: bool(result["returns"][0] > _SOLVED["reacher-random"]),
    ),
    "ant": Bed(
        "return of the first 1,000 steps",
        f"above {_SOLVED['ant-unseen']:g}",
        partial(ant.damage_of, "unseen"),
        partial(ant.run, args=ant.Args()),
        lambda result: float(result["return"]),
        lambda result: bool(result["return"] > _SOLVED["ant-unseen"]),
    ),
    "quadruped": Bed(
        f"gaits to the goal, else {_GAITS + 1}",
        "at the goal",
        lambda seed: quadruped.task_of("both", seed, quadruped.Args()).situation,
        quadruped.run,
        lambda result: float(result["gaits"] if result["reached"] else _GAITS + 1),
        lambda result: bool(result["reached"]),
    ),
    "minitaur": Bed(
        "metres in 60 gaits",
        "on its feet",
        lambda seed: Situation(),
        quadruped.run,
        lambda result: float(result["distance"]),
        lambda result: not result["fell"],
    ),
}
"""Robots by name."""


@dataclass(frozen=True)
class Args(Options):
    """Agents that are meta-learned in one engine and run in the other."""

    methods: tuple[str, ...] = ("famle", FROZEN, "famle-nearest", "ampc-reptile", "ampc", ORACLE, HOME)
    """Entries of benchmarks.methods.METHODS; oracle and home are FAMLE that knows the robot's engine."""
    robots: tuple[str, ...] = tuple(BEDS)
    """What is broken."""
    simulator: Engine = "pybullet"
    """The engine that agents learn in; robots run in the other one."""
    replicates: int = 12
    """Seeds 0, 1, ..."""
    meta_trainings: int = 3
    """Independent ones that replicates take turns with, where the package ships no model."""

    def __post_init__(self) -> None:
        if unknown := set(self.robots) - set(BEDS):
            raise ValueError(f"There is no robot {min(unknown)!r}. Robots: {', '.join(BEDS)}.")


def task_of(robot: str, seed: int, args: Args) -> Task:
    """Makes the test robot of a replicate."""
    return Task(
        robot,
        seed,
        BEDS[robot].situation(seed),
        cache_of(args.simulator, args.cache),
        device=args.device,
        engine=OTHER[args.simulator],
        simulator=args.simulator,
        meta_trainings=args.meta_trainings,
    )


def cache_of(simulator: Engine, cache: Path) -> Path:
    """Names the folder of what is learnt in an engine: files are named after robots and methods, and not after that."""
    return cache if simulator == "pybullet" else cache / simulator


def run(method: str, tasks: Sequence[Task], cache: Path) -> list[Result]:
    """Runs one replicate."""
    if method == ORACLE:
        tasks = [replace(task, simulator=task.engine, cache=cache_of(task.engine, cache)) for task in tasks]
    if method == HOME:
        tasks = [replace(task, engine=task.simulator) for task in tasks]
    return BEDS[tasks[0].robot].run("famle" if method in (ORACLE, HOME) else method, tasks)


def path_of(robot: str, simulator: Engine, out: Path) -> Path:
    """Names the table of a robot and a direction."""
    return out / f"sim-to-sim-{robot}-to-{OTHER[simulator]}.csv"


def scores(robot: str, results: pd.DataFrame) -> pd.DataFrame:
    """Reads what each replicate is judged by: a row a seed, a column a method; NaN where it was not run."""
    judged = results.assign(score=results.apply(BEDS[robot].score, axis="columns"))
    table = judged.pivot(index="seed", columns="method", values="score")
    return table[in_order(table.columns)]


def summary(robot: str, results: pd.DataFrame) -> pd.DataFrame:
    """Makes a table with a row a method: interquartile mean, recovery, and the part of the gap that it closes."""
    by_seed = scores(robot, results)
    share = results.apply(BEDS[robot].recovered, axis="columns").groupby(results["method"]).mean()
    rows = {}
    for method in map(str, by_seed):
        values = by_seed[method].dropna()
        closed = (math.nan,) * 3
        if {FROZEN, ORACLE} <= set(by_seed):
            closed = gap_closed(*by_seed[[method, FROZEN, ORACLE]].dropna().to_numpy().T)
        figures = (len(values), values.median(), *interquartile_mean(values), share[method], *closed)
        rows[method] = dict(zip(_COLUMNS, figures, strict=True))
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("method")


_COLUMNS = ("n", "median", "iqm", "iqm_low", "iqm_high", "recovered", "gap_closed", "gap_low", "gap_high")


def picture(out: Path) -> Figure:
    """Draws all that is stored: a panel a robot and a direction."""
    panels = {}
    for simulator in OTHER:
        for robot, bed in BEDS.items():
            if (path := path_of(robot, simulator, out)).exists():
                where = f"{robot}, {NAMES[simulator]} to {NAMES[OTHER[simulator]]}"
                panels[where] = (scores(robot, load(path)), bed.label)
    return draw_scores(panels)


def main(args: Args) -> None:
    """Runs what is not stored, prints a summary of each robot, and draws all that is stored."""
    for robot in args.robots:
        tasks = [task_of(robot, seed, args) for seed in range(args.replicates)]
        table = path_of(robot, args.simulator, args.out)
        compare(args.methods, tasks, partial(run, cache=args.cache), table, args, KNOWN)
        found = summary(robot, load(table)).rename(index=lambda method: style_of(method).label)
        bed, where = BEDS[robot], NAMES[OTHER[args.simulator]]
        print(f"\n{robot} in {where}, learnt in {NAMES[args.simulator]}: {bed.label}; recovered: {bed.recovery}")
        print((found.round(2) + 0.0).to_string())  # without a sign before 0
    with whole_file(args.out / "sim-to-sim.png") as partial_file:
        picture(args.out).savefig(partial_file, format="png", dpi=100)


if __name__ == "__main__":
    launch(main, Args)
