"""What more training situations than the paper's are worth, on the arm: returns, what they cost, and time.

python -m benchmarks.many_situations
python -m benchmarks.many_situations --sets prescribed 100 --replicates 5

Beside those that the paper prescribes, situations are drawn as those of the test arms are, one or two faults of all
kinds and degrees, with other seeds. Each test arm lives two episodes; nobody has told the agent what is wrong with it.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import torch

from benchmarks.methods import from_cache
from benchmarks.results import Result, load
from benchmarks.runner import Batch, Execution, launch, run_batches
from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.rollout import rollout
from famle_envs import Situation
from famle_envs.reacher import ReacherEnv

EPISODES = 2


@dataclass(frozen=True)
class Set:
    """The training situations of a method.

    Attributes:
        drawn: How many are drawn, beside those prescribed.
        compose: Whether sums of two are candidates.
    """

    drawn: int
    compose: bool


SETS: Mapping[str, Set] = {
    "prescribed": Set(0, compose=True),
    "prescribed, no sums": Set(0, compose=False),
    "100": Set(89, compose=True),
    "100, no sums": Set(89, compose=False),
    "1000, no sums": Set(989, compose=False),
}
"""Their number; the prescribed ones are 11, and with 1,000 there would be half a million sums."""


@dataclass(frozen=True)
class Args(Execution):
    """What more training situations are worth."""

    sets: tuple[str, ...] = tuple(SETS)
    """Entries of SETS."""
    replicates: int = 10
    """Test arms."""


def drawn(split: int, n: int) -> list[Situation]:
    """Draws n different situations of one or two faults; each split has others."""
    rng, found = np.random.default_rng([2026, split]), dict[Situation, None]()
    while len(found) < n:
        found[ReacherEnv.sample_situation(rng, n_faults=int(rng.integers(1, 3)))] = None
    return list(found)


def agent_of(name: str, seed: int, cache: Path) -> tuple[FAMLE, float | None]:
    """Makes the arm's agent with its default settings but for the situations; what it meta-learns is kept.

    Returns:
        The agent, and the processor's seconds that it learnt; None where it was in the cache.
    """
    chosen, start = SETS[name], time.process_time()
    agent = FAMLE("reacher", seed=seed, device="cpu", compose=chosen.compose)
    situations = [*ReacherEnv.training_situations, *drawn(1 + seed, chosen.drawn)]
    path = cache / f"reacher-{len(situations)}-situations-{seed}.zip"
    known = path.exists()
    from_cache(agent, path, lambda agent: agent.meta_learn(situations))
    return agent, None if known else time.process_time() - start


def run(name: str, replicates: int, cache: Path) -> list[Result]:
    """Runs one agent on all test arms, one after the other."""
    agent, learning = agent_of(name, 0, cache)
    results = list[Result]()
    for situation in drawn(0, replicates):
        agent.forget()
        agent.set_random_seed(0)
        env = FAMLEWrapper(gym.make("FamleReacher-v0", situation=situation), agent)
        returns = [round(rollout(env, number).total, 2) for number in range(EPISODES)]
        env.close()
        results.append(
            {"situation": str(situation), "returns": returns, "cpu_seconds": learning, "judge_ms": judge_ms(agent)}
        )
    return results


@torch.no_grad()
def judge_ms(agent: FAMLE, times: int = 20) -> float:
    """Measures the milliseconds in which a transition is judged under all candidates."""
    adapter, model = agent.adapter, agent.model
    obs, action = torch.zeros(1, model.obs_dim), torch.zeros(1, model.action_dim)
    belief, seconds = adapter.initial(1), list[float]()
    for _ in range(times):
        start = time.perf_counter()
        adapter.judge(belief, obs, action, obs)
        seconds.append(time.perf_counter() - start)
    return round(1e3 * float(np.median(seconds)), 3)


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Takes the mean and the worst return of each episode, what the training took, and what a judgement takes."""
    returns = pd.DataFrame(list(results["returns"]), columns=[f"episode {i + 1}" for i in range(EPISODES)])
    grouped = returns.groupby(results["method"].to_numpy(), sort=False)
    costs = results.groupby("method", sort=False)[["cpu_seconds", "judge_ms"]].median()
    return grouped.mean().join(grouped.min(), rsuffix=", worst").join(costs)


def main(args: Args) -> None:
    """Runs what is not stored, and prints what more situations give."""
    table = args.out / "many-situations.csv"
    for name in args.sets:
        batch = Batch(name, tuple(range(args.replicates)), partial(run, name, args.replicates, args.cache))
        run_batches([batch], table, args.jobs, args.backend)
    print(summary(load(table)).round(2).to_string())


if __name__ == "__main__":
    launch(main, Args)
