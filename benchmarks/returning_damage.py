"""Damage that comes back: what it is worth that a robot has kept what it had learnt of it.

python -m benchmarks.returning_damage
python -m benchmarks.returning_damage --robots ant --replicates 10

Three motors of a robot lose what they lose in no training situation, are repaired, and later lose the same again.
Nobody tells the agent. What it predicts with the model that it plans with, and what it gets, count from the second
time on; until then both methods do the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch

from benchmarks.changing_damage import BEDS
from benchmarks.results import Result, load
from benchmarks.runner import Batch, Execution, launch, run_batches
from famle_agent import FAMLEWrapper, ModelBasedAgent
from famle_envs import Situation
from famle_envs.faults import make_faulty

Array = npt.NDArray[np.float64]

LIBRARY_SIZES: Mapping[str, int] = {"without library": 0, "library": 4}
"""Methods by name."""
BROKEN, REPAIRED, AGAIN = 240, 120, 100
"""Steps of each time of a robot's life."""
BIN = 10
"""Steps of a stored mean."""


@dataclass(frozen=True)
class Args(Execution):
    """Robots whose damage comes back."""

    robots: tuple[str, ...] = tuple(BEDS)
    """Entries of benchmarks.changing_damage.BEDS."""
    methods: tuple[str, ...] = tuple(LIBRARY_SIZES)
    """Whether robots have a library; entries of LIBRARY_SIZES."""
    replicates: int = 4
    """Seeds 0, 1, ..."""

    def __post_init__(self) -> None:
        for names, known in ((self.robots, BEDS), (self.methods, LIBRARY_SIZES)):
            if unknown := set(names) - set(known):
                raise ValueError(f"There is no {', '.join(unknown)}. Known: {', '.join(known)}.")


def damage(motors: int, seed: int) -> Situation:
    """Draws three motors, and what is left of each: from half of it, reversed, to half of it."""
    rng, gain = np.random.default_rng([2028, seed]), np.ones(motors)
    gain[rng.choice(motors, size=3, replace=False)] = rng.uniform(-0.5, 0.5, size=3).round(2)
    return Situation(motor_gain=tuple(gain))


def run(robot: str, method: str, seed: int, cache: Path) -> list[Result]:
    """Runs one robot through the damage, its repair, and the damage again."""
    bed = BEDS[robot]
    agent = bed.agent(seed, cache)
    agent.config = agent.config.changed(library_size=LIBRARY_SIZES[method])
    agent.forget()
    agent.set_random_seed(seed)
    broken = damage(len(agent.action_space.low), seed)
    env = FAMLEWrapper(make_faulty(bed.env_id, max_episode_steps=bed.episode), agent)
    obs, _ = env.reset(seed=seed)
    rewards, errors = list[float](), list[float]()
    for situation, steps in ((broken, BROKEN), (Situation(), REPAIRED), (broken, AGAIN)):
        env.get_wrapper_attr("set_situation")(situation)
        for _ in range(steps):
            action = agent.predict(obs)[0]
            expected = prediction(agent, obs, action)
            last, (obs, reward, terminated, truncated, _) = obs, env.step(action)
            rewards.append(float(reward))
            errors.append(distance(agent, last, expected, obs))
            if terminated or truncated:
                obs, _ = env.reset()
    env.close()
    of_bins = (np.array(values)[-AGAIN:].reshape(-1, BIN).mean(axis=1) for values in (rewards, errors))
    again = ([round(float(value), 3) for value in values] for values in of_bins)
    return [{"situation": str(broken), **dict(zip(("rewards", "errors"), again, strict=True))}]


def prediction(agent: ModelBasedAgent, obs: Array, action: Array) -> torch.Tensor:
    """Predicts where an action leads, with the model that the agent plans with, (obs_dim,)."""
    state, builder = agent.state_of(1), agent.policy.builder
    at, unit = builder.tensor(obs), builder.action_scale.to_unit(builder.tensor(action))
    model = agent.adapter.model_for(state.belief, state.memory)
    return model(at[None, None], unit[None, None]).mean(dim=1)[0, 0]


def distance(agent: ModelBasedAgent, obs: Array, expected: torch.Tensor, next_obs: Array) -> float:
    """Computes the root mean square of an error, in deviations of the change of a step."""
    tensor, model = agent.policy.builder.tensor, agent.model
    at, there = tensor(obs), tensor(next_obs)
    error = model.layout.change(at, expected) - model.layout.change(at, there)
    return float((error / model.target_std).square().mean().sqrt())


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Takes means over robots of the error and the reward in the first steps of the second time."""
    columns = {}
    for steps in (20, 50, AGAIN):
        for name in ("errors", "rewards"):
            values = [np.mean(of_one[: steps // BIN]) for of_one in results[name]]
            columns[f"{name.removesuffix('s')}, {steps} steps"] = values
    together = pd.DataFrame(columns).groupby(results["method"].to_numpy(), sort=False)
    return together.mean().join(together.size().rename("robots"))


def main(args: Args) -> None:
    """Runs what is not stored, and prints how robots do when their damage comes back."""
    table = args.out / "returning-damage.csv"
    batches = [
        Batch(f"{robot}, {method}", (seed,), partial(run, robot, method, seed, args.cache))
        for robot in args.robots
        for seed in range(args.replicates)
        for method in args.methods
    ]
    run_batches(batches, table, args.jobs, args.backend)
    print(summary(load(table)).round(3).to_string())


if __name__ == "__main__":
    launch(main, Args)
