"""What each piece of FAMLE's adaptation is worth, on our robots and on Gymnasium's: each taken away by itself.

python -m benchmarks.ablations
python -m benchmarks.ablations --robots reacher ant --pieces all frozen

Agents are those of the other benchmarks, none is trained for this one. Damages are drawn as those of validation, but
for those that walk by gaits, which have one held-out profile each, and for the beds of `benchmarks.gym_robots`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from benchmarks import gym_robots, minitaur, quadruped
from benchmarks.methods import famle
from benchmarks.results import Result, load
from benchmarks.runner import Batch, Execution, launch, run_batches
from benchmarks.task import Task
from famle_agent import FAMLEWrapper, ModelBasedAgent
from famle_agent.rollout import Rollout, rollout
from famle_envs.ant import AntEnv
from famle_envs.reacher import ReacherEnv

PIECES: Mapping[str, Mapping[str, Any]] = {
    "all": {},
    "no sums": {"compose": False},
    "whole evidence": {"likelihood_power": 1.0},
    "steps anew": {"warm_start": False},
    "no steps": {"adapt_steps": 0},
    "nearest embedding": {"adapt_steps": 0, "compose": False},
    "frozen": {"adapt_every": 0},
}
"""What is taken away: nothing; sums of embeddings; evidence that is tempered; gradient steps that go on;
all gradient steps; these and sums; all adaptation."""


@dataclass(frozen=True)
class Robot:
    """A robot, and what counts on it.

    Attributes:
        agent: Makes the agent of a replicate with some settings.
        make: Makes the broken robot of a replicate.
        score: What a life was worth.
        replicates: How many there are.
    """

    agent: Callable[[int, Mapping[str, Any]], ModelBasedAgent]
    make: Callable[[int], gym.Env[Any, Any]]
    score: Callable[[Rollout], float]
    replicates: int


def earned(life: Rollout) -> float:
    """Returns the return."""
    return life.total


def gaits(life: Rollout) -> float:
    """Counts the gaits to the goal, less than 0 since fewer are better; 80 where it is not reached."""
    return -float(life.steps if life.success else 80)


def metres(life: Rollout) -> float:
    """Returns how far it has walked."""
    return float(life.position[-1, 0])


def ours(task: Callable[[int], Task], score: Callable[[Rollout], float], replicates: int, **kwargs: Any) -> Robot:
    """Describes one of our robots."""
    return Robot(
        lambda seed, settings: famle(task(seed), **settings),
        lambda seed: task(seed).make(**kwargs),
        score,
        replicates,
    )


def bed(name: str, seeds: int, cache: Path, change: tuple[str, ...] = (), lives: int = 3) -> Robot:
    """Describes a bed of Gymnasium's robots: all unseen robots of some meta-trainings, some lives of each."""
    makes = list(gym_robots.BEDS[name]().test.values())

    def agent(number: int, settings: Mapping[str, Any]) -> ModelBasedAgent:
        agent = gym_robots.agent_of("famle", name, number // (lives * len(makes)), cache, change)
        agent.config = agent.config.changed(**settings)
        return agent

    return Robot(agent, lambda number: makes[number % len(makes)](), earned, seeds * lives * len(makes))


def robots(cache: Path) -> Mapping[str, Robot]:
    """Lists the robots by name."""
    few = ("policy_steps=200000",)

    def drawn(robot: str, kind: type[AntEnv] | type[ReacherEnv], seed: int) -> Task:
        return Task(robot, seed, kind.sample_situation(np.random.default_rng([7, seed])), cache)

    return {
        "reacher": ours(partial(drawn, "reacher", ReacherEnv), earned, 12),
        "ant": ours(partial(drawn, "ant", AntEnv), earned, 8, max_episode_steps=400),
        "quadruped": ours(lambda seed: quadruped.task_of("both", seed, quadruped.Args(cache=cache)), gaits, 12),
        "minitaur": ours(lambda seed: minitaur.task_of("held-out", seed, minitaur.Args(cache=cache)), metres, 10),
        "halfcheetah": bed("halfcheetah", 2, cache, few),
        "pendulum": bed("pendulum", 2, cache, few),
        "pusher": bed("pusher", 1, cache),
        "walker2d": bed("walker2d", 1, cache),
        "hopper": bed("hopper", 1, cache),
    }


@dataclass(frozen=True)
class Args(Execution):
    """What each piece of adaptation is worth."""

    robots: tuple[str, ...] = tuple(robots(Path()))
    """Our robots, and beds of benchmarks.gym_robots."""
    pieces: tuple[str, ...] = tuple(PIECES)
    """What is taken away; the others are compared with "all", which runs too."""

    def __post_init__(self) -> None:
        for names, known in ((self.robots, robots(self.cache)), (self.pieces, PIECES)):
            if unknown := set(names) - set(known):
                raise ValueError(f"There is no {', '.join(unknown)}. Known: {', '.join(known)}.")


def run(robot: str, piece: str, number: int, cache: Path) -> list[Result]:
    """Lets one robot live an episode without a piece."""
    chosen = robots(cache)[robot]
    agent = chosen.agent(number, PIECES[piece])
    agent.set_random_seed(number)
    env = FAMLEWrapper(chosen.make(number), agent)
    life = rollout(env, number)
    env.close()
    return [{"robot": robot, "score": round(chosen.score(life), 3), "steps": life.steps}]


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Takes what is left without each piece, and the mean difference of pairs to all pieces with its standard error."""
    scores = results.pivot(index="seed", columns="method", values="score")
    apart = scores.sub(scores["all"], axis=0)
    columns = {"mean": scores.mean(), "median": scores.median(), "less all": apart.mean(), "+-": apart.sem()}
    return pd.DataFrame(columns).loc[[piece for piece in PIECES if piece in scores]]


def main(args: Args) -> None:
    """Runs what is not stored, and prints what is left without each piece."""
    for robot in args.robots:
        table, n = args.out / f"ablations-{robot}.csv", robots(args.cache)[robot].replicates
        batches = [
            Batch(piece, (number,), partial(run, robot, piece, number, args.cache))
            for piece in dict.fromkeys(("all", *args.pieces))
            for number in range(n)
        ]
        run_batches(batches, table, args.jobs, args.backend)
        print(f"\n{robot}")
        print(summary(load(table)).round(2).to_string())


if __name__ == "__main__":
    launch(main, Args)
