"""Damage in mid-life: an arm that has lived an intact episode breaks before the next one.

python -m benchmarks.mid_life
python -m benchmarks.mid_life --methods famle --replicates 3

Each replicate has a meta-training of its own and two faults, drawn as the validation arms' are and not as those of the
test arms: settings were decided by this benchmark.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd

from benchmarks.methods import METHODS, model_based
from benchmarks.results import Result, load
from benchmarks.runner import Options, compare, launch
from benchmarks.task import Task
from famle_agent import FAMLEWrapper
from famle_agent.rollout import rollout
from famle_envs import Situation
from famle_envs.reacher import ReacherEnv


@dataclass(frozen=True)
class Args(Options):
    """Arms that break in mid-life."""

    methods: tuple[str, ...] = ("famle", "famle-frozen")
    """Entries of benchmarks.methods.METHODS."""
    episodes: int = 4
    """Of each arm; it is broken in all but the first."""


def run(method: str, tasks: Sequence[Task], episodes: int) -> list[Result]:
    """Lets one arm live, and breaks it."""
    (task,) = tasks
    agent = model_based(METHODS[method], task)
    env, returns = FAMLEWrapper(task.make(), agent), list[float]()
    for number in range(episodes):
        if number == 1:
            env.unwrapped.set_situation(task.later)  # type: ignore[attr-defined]
        returns.append(round(rollout(env, number).total, 2))
    env.close()
    return [{"situation": str(task.later), "believed": agent.diagnose().situation, "returns": returns}]


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Takes the mean return of each episode."""
    returns = pd.DataFrame(list(results["returns"]), index=results["method"])
    return returns.rename(columns="episode {}".format).groupby(level=0, sort=False).mean()


def main(args: Args) -> None:
    """Runs what is not stored, and prints the mean return of each episode."""
    damages = [ReacherEnv.sample_situation(np.random.default_rng([7, seed])) for seed in range(args.replicates)]
    tasks = [Task("reacher", seed, Situation(), args.cache, later=damage) for seed, damage in enumerate(damages)]
    table = args.out / "mid-life.csv"
    compare(args.methods, tasks, partial(run, episodes=args.episodes), table, args)
    print(summary(load(table)).round(1).to_string())


if __name__ == "__main__":
    launch(main, Args)
