"""Damage that changes: how long robots take to recover from a second change, beside the first.

python -m benchmarks.changing_damage
python -m benchmarks.changing_damage --robots ant --replicates 10

A motor of an intact robot fails, and later that changes: another motor fails in place of it, it heals, one fault goes
slowly as the next one comes, or faults flicker. Nobody tells the agent, and nothing is reset but where episodes end.

A robot has recovered at the first step from which on the mean reward of a window of steps is at least 80 % of what it
gets later with that damage: in the second half of the time until the next change. Steps are counted from where a change
is complete. A robot that does not adapt gets less later, but may get there at once, so that the rewards tell as much
as the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from benchmarks.gym_robots import agent_of
from benchmarks.methods import famle
from benchmarks.results import Result, load
from benchmarks.runner import Batch, Execution, launch, run_batches
from benchmarks.task import Task
from famle_agent import FAMLEWrapper, ModelBasedAgent
from famle_envs import Situation
from famle_envs.faults import make_faulty

Array = npt.NDArray[np.float64]

ENOUGH = 0.8
"""The share of what a robot gets later that counts as recovered."""
FLICKER = 10
"""Steps for which a flickering fault is there, and then is not."""
BIN = 10
"""Steps of a stored mean reward."""


@dataclass(frozen=True)
class Bed:
    """A robot and its agent.

    Attributes:
        env_id: Its Gymnasium id.
        agent: Makes the agent of a replicate, by its seed and the folder of what is meta-learned.
        gain: What is left of a motor that fails.
        phase: Steps from one change to the next.
        episode: Steps of an episode.
        window: Steps of a mean reward: an episode of the arm, which may be at its goal when a motor fails.
    """

    env_id: str
    agent: Callable[[int, Path], ModelBasedAgent]
    gain: float
    phase: int
    episode: int
    window: int = 50


def _of_ours(robot: str, seed: int, cache: Path) -> ModelBasedAgent:
    return famle(Task(robot, seed, Situation(), cache))


def _of_gym(name: str, seed: int, cache: Path) -> ModelBasedAgent:
    return agent_of("famle", name, seed % 2, cache, ("policy_steps=200000",))  # of two meta-trainings


BEDS: Mapping[str, Bed] = {
    "arm": Bed("FamleReacher-v0", partial(_of_ours, "reacher"), gain=-1.0, phase=100, episode=50),
    "ant": Bed("FamleAnt-v0", partial(_of_ours, "ant"), gain=0.0, phase=240, episode=1000),
    "halfcheetah": Bed("HalfCheetah-v5", partial(_of_gym, "halfcheetah"), gain=0.0, phase=180, episode=1000),
}
"""Robots by name."""


@dataclass(frozen=True)
class Args(Execution):
    """Robots whose damage changes."""

    robots: tuple[str, ...] = tuple(BEDS)
    """Entries of BEDS."""
    methods: tuple[str, ...] = ("another", "heals", "slow", "flickers")
    """How damage changes; entries of CHANGES."""
    replicates: int = 4
    """Seeds 0, 1, ...; two that follow each other have the same two motors fail, one in the order of the other."""


# --- what happens to the motors ---------------------------------------------------------------------------------------


def _at_once(before: Array, after: Array, steps: int) -> Array:
    return np.tile(after, (steps, 1))


def _slowly(before: Array, after: Array, steps: int) -> Array:
    done = np.linspace(0.0, 1.0, ramp(steps) + 1)[1:, None]
    return np.concatenate([before + done * (after - before), np.tile(after, (steps - len(done), 1))])


def _flickering(before: Array, after: Array, steps: int) -> Array:
    off = (np.arange(steps) // FLICKER) % 2 == 1
    return np.where(off[:, None], 1.0, after)


def ramp(phase: int) -> int:
    """Counts the steps in which a fault comes that comes slowly."""
    return phase // 4


@dataclass(frozen=True)
class Change:
    """How damage changes.

    Attributes:
        gains: Makes the gains of the motors after a change, (steps, motors), of those before and after it, (motors,).
        heals: Whether the second change is back to an intact robot, and not to another fault.
        takes: Makes the steps that a change takes of those until the next.
    """

    gains: Callable[[Array, Array, int], Array] = _at_once
    heals: bool = False
    takes: Callable[[int], int] = lambda phase: 0


CHANGES: Mapping[str, Change] = {
    "another": Change(),
    "heals": Change(heals=True),
    "slow": Change(_slowly, takes=ramp),
    "flickers": Change(_flickering),
}
"""How damage changes, by name."""


def faults(heals: bool, gain: float, motors: int, seed: int) -> tuple[Array, Array]:
    """Draws what is left of each motor after the first change and after the second, (motors,) each."""
    pair = np.random.default_rng([2027, seed // 2]).permutation(motors)[:2]
    first, second = (np.where(np.arange(motors) == pair[i ^ seed % 2], gain, 1.0) for i in range(2))
    return first, np.ones(motors) if heals else second


# --- what becomes of the robot ----------------------------------------------------------------------------------------


def run(robot: str, change: str, seed: int, cache: Path) -> list[Result]:
    """Runs one robot through two changes."""
    bed, how = BEDS[robot], CHANGES[change]
    agent = bed.agent(seed, cache)
    agent.forget()
    agent.set_random_seed(seed)
    motors = len(agent.action_space.low)
    intact, (first, second) = np.ones(motors), faults(how.heals, bed.gain, motors, seed)
    damage = [how.gains(before, after, bed.phase) for before, after in ((intact, first), (first, second))]
    schedule = np.concatenate([np.tile(intact, (bed.phase, 1)), *damage])
    env = FAMLEWrapper(make_faulty(bed.env_id, max_episode_steps=bed.episode), agent)
    rewards = rollout(env, schedule, seed)
    env.close()
    phases, half = rewards.reshape(3, bed.phase), bed.phase // 2
    return [
        {
            "situation": str(Situation(motor_gain=tuple(first))),
            "later": str(Situation(motor_gain=tuple(second))),
            "recovery": [recovery(phase[how.takes(bed.phase) :], bed.window, half) for phase in phases[1:]],
            "levels": [round(float(level), 3) for level in phases[:, half:].mean(axis=1)],
            "rewards": [round(float(value), 3) for value in rewards.reshape(-1, BIN).mean(axis=1)],
        }
    ]


def rollout(env: FAMLEWrapper, schedule: Array, seed: int) -> Array:
    """Runs through gains of motors (steps, motors), over any number of episodes; returns the rewards, (steps,)."""
    set_situation, rewards, known = env.get_wrapper_attr("set_situation"), np.zeros(len(schedule)), None
    obs, _ = env.reset(seed=seed)
    for i, gain in enumerate(map(tuple, schedule)):
        if gain != known:
            set_situation(Situation(motor_gain=gain))
            known = gain
        obs, rewards[i], terminated, truncated, _ = env.step(env.agent.predict(obs)[0])
        if terminated or truncated:
            obs, _ = env.reset()
    return rewards


def recovery(rewards: Array, window: int, later: int) -> int:
    """Counts the steps after a change until a robot has recovered, as the module says; all of them where it has not.

    Args:
        rewards: Since the change is complete, (steps,).
        window: Steps of a mean.
        later: Steps at the end of which the mean is what the robot gets later.
    """
    level = rewards[-later:].mean()
    means = np.convolve(rewards, np.full(window, 1.0 / window), mode="valid")
    enough = means >= level - (1.0 - ENOUGH) * abs(level)
    return int(np.argmax(enough)) if enough.any() else len(rewards)


def summary(results: pd.DataFrame) -> pd.DataFrame:
    """Takes means of the steps to recover from each change, and of the rewards before and after, by robot and kind."""
    steps = pd.DataFrame(list(results["recovery"]), columns=["first", "second"])
    levels = pd.DataFrame(list(results["levels"]), columns=["intact", "first fault", "second fault"])
    together = steps.join(levels).groupby(results["method"].to_numpy(), sort=False)
    return together.mean().join(together.size().rename("robots"))


def main(args: Args) -> None:
    """Runs what is not stored, and prints the steps to recover from each change.

    Raises:
        ValueError: A robot or a change is unknown.
    """
    for names, known in ((args.robots, BEDS), (args.methods, CHANGES)):
        if unknown := set(names) - set(known):
            raise ValueError(f"There is no {', '.join(unknown)}. Known: {', '.join(known)}.")
    table = args.out / "changing-damage.csv"
    batches = [
        Batch(f"{robot}, {change}", (seed,), partial(run, robot, change, seed, args.cache))
        for robot in args.robots
        for change in args.methods
        for seed in range(args.replicates)
    ]
    run_batches(batches, table, args.jobs, args.backend)
    print(summary(load(table)).round(2).to_string())


if __name__ == "__main__":
    launch(main, Args)
