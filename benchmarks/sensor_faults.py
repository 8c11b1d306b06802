"""What comes out of an agent while its sensors fail: actions that are none, and beliefs that are not finite.

python -m benchmarks.sensor_faults                             # the four robots and HalfCheetah, 2,000 steps a fault
python -m benchmarks.sensor_faults --robots ant --steps 20000  # one of them

A fault strikes in bursts, on sensors that change from one to the next. Models are shipped, or hardly trained, and plans
are cheap: an action is valid, and a belief finite, whatever they are worth.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch

from benchmarks.results import Result, load, provenance, store
from benchmarks.runner import launch
from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.agents.presets import make_env

Array = npt.NDArray[Any]

_HARDLY: dict[str, Any] = {"policy_steps": 0, "transitions_per_situation": 200, "meta_iterations": 0}

ROBOTS: Mapping[str, Mapping[str, Any]] = {
    "reacher": {"transitions_per_situation": 400, "joint_iterations": 300, "rounds": 0, "meta_iterations": 20},
    "ant": {},
    "quadruped": {},
    "minitaur": {},
    "HalfCheetah-v5": {**_HARDLY, "joint_iterations": 300, "hidden": (64, 64), "members": 2},
}
"""Settings of the agent of each robot; those without any have a model that is shipped."""

_QUICK: dict[str, Any] = {"candidates": 20, "planner_iterations": 1, "horizon": 5, "adapt_every": 10}
_MOTORS = ("motor 0 dead", "motor 1 dead")  # what is wrong with a robot that trains on no situations of its own
_STARTS, _LONGEST = 0.05, 30  # probability per step that a burst begins, and steps that it lasts at most


@dataclass(frozen=True)
class Args:
    """Counts what comes out of agents whose sensors fail."""

    robots: tuple[str, ...] = tuple(ROBOTS)
    """Robots."""
    faults: tuple[str, ...] = ()
    """Faults; by default all."""
    steps: int = 2000
    """Control steps with each fault."""
    seed: int = 0
    """Of the robot, the planner and the faults."""
    out: Path = Path("benchmarks/results")
    """Folder of sensor-faults.csv."""

    def __post_init__(self) -> None:
        for names, known in ((self.robots, ROBOTS), (self.faults, FAULTS)):
            if unknown := set(names) - set(known):
                raise ValueError(f"There is no {', '.join(unknown)}. Known: {', '.join(known)}.")


class BrokenSensors(gym.Wrapper[Any, Array, Any, Array]):
    """Breaks sensors in bursts.

    Args:
        env: The robot.
        fault: What becomes of the last readings, the newest one last, where some sensors (obs_dim,) are broken.
        rng: When, which and for how long.
    """

    def __init__(self, env: gym.Env[Any, Any], fault: Fault, rng: np.random.Generator) -> None:
        super().__init__(env)
        self._fault, self._rng, self._left = fault, rng, 0
        self._past: deque[Array] = deque(maxlen=_LONGEST + 2)
        self.faulty = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode, whose first reading is right."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._past.clear()
        self._past.append(obs)
        self._left = 0
        return obs, info

    def step(self, action: Array) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the robot, and reads its sensors."""
        obs, *rest = self.env.step(action)
        self._past.append(obs)
        if not self._left and self._rng.random() < _STARTS:
            self._left = self._length = int(self._rng.integers(1, _LONGEST + 1))
            one, sensor = self._rng.random() < 0.5, self._rng.integers(len(obs))
            self._broken = np.arange(len(obs)) == sensor if one else np.ones(len(obs), dtype=bool)
        if self._left:
            self.faulty += 1
            obs = self._fault(list(self._past), self._broken, self._length - self._left + 1)
            self._left -= 1
        return obs, *rest


Fault = Callable[[list[Array], Array, int], Any]
"""(the last readings, which sensors are broken, since how many steps) -> what is read."""


def _set(value: float) -> Fault:
    return lambda past, broken, age: np.where(broken, value, past[-1]).astype(np.float32)


def _older(steps: Callable[[int], int]) -> Fault:
    """Reads what was to be read some steps ago, by the age of the fault."""
    return lambda past, broken, age: np.where(broken, past[max(-1 - steps(age), -len(past))], past[-1])


def _jumping(past: list[Array], broken: Array, age: int) -> Array:
    far: Array = 1e3 * (1.0 + np.abs(past[-1])) * (-1.0) ** age
    return np.where(broken, past[-1] + far, past[-1]).astype(np.float32)


FAULTS: Mapping[str, Fault] = {
    "NaN": _set(np.nan),
    "infinite": _set(np.inf),
    "out of range": _set(-1e30),
    "no message": lambda past, broken, age: None,
    "jumping": _jumping,
    "frozen": _older(lambda age: age),
    "repeated": _older(lambda age: age % 2),
    "late": _older(lambda age: min(age, 3)),
}


def main(args: Args) -> None:
    """Drives each robot with each fault, and stores a row of each."""
    warnings.filterwarnings("ignore", message="An observation of robot|Adaptation .* diverged")
    torch.set_num_threads(1)
    file = args.out / "sensor-faults.csv"
    for robot in args.robots:
        agent = agent_of(robot, args.seed)
        for fault in args.faults or FAULTS:
            row = run(agent, robot, fault, args.steps, args.seed)
            row |= {"robot": robot, "fault": fault, **provenance(sys.argv)}
            store(file, [row], keys=("robot", "fault"))
    print(load(file).drop(columns=["command", "commit", "versions"]).to_string(index=False))


def agent_of(robot: str, seed: int) -> FAMLE:
    """Makes a robot's agent, which knows a safe action."""
    with closing(make_env(robot)) as env:
        idle = np.clip(0.0, env.action_space.low, env.action_space.high).tolist()  # type: ignore[attr-defined]
    agent = FAMLE(robot, seed=seed, device="cpu", safe_action=idle, **{**_QUICK, **ROBOTS[robot]})
    if agent.dynamics is None:
        own = agent.get_env().has_attr("training_situations")  # type: ignore[union-attr]
        agent.meta_learn(None if own else ["intact", *_MOTORS], check=False)
    return agent


def run(agent: FAMLE, robot: str, fault: str, steps: int, seed: int) -> Result:
    """Counts what comes out of some steps with a fault."""
    agent.forget()
    agent.set_random_seed(seed)
    made: Any = make_env(robot)
    sensors = BrokenSensors(made, FAULTS[fault], np.random.default_rng(seed))
    env = FAMLEWrapper(sensors, agent)
    invalid = unbelievable = 0
    start = time.perf_counter()
    with closing(env):
        obs, _ = env.reset(seed=seed)
        for _ in range(steps):
            action, _ = agent.predict(obs)
            invalid += not env.action_space.contains(action)
            obs, _, terminated, truncated, _ = env.step(action)
            unbelievable += not _is_finite(agent)
            if terminated or truncated:
                obs, _ = env.reset()
    health = agent.health()
    return {
        "steps": steps,
        "faulty_steps": sensors.faulty,
        "invalid_actions": invalid,
        "non_finite_beliefs": unbelievable,
        **{name: health[name] for name in ("quarantined", "dropped", "repeated")},
        "adaptations": agent.belief.adaptations,
        "ms_per_step": round(1e3 * (time.perf_counter() - start) / steps, 1),
    }


def _is_finite(agent: FAMLE) -> bool:
    belief = agent.belief
    numbers = [*belief.theta.values(), belief.h, belief.log_posterior, belief.bias, belief.excess]
    return all(bool(values.isfinite().all()) for values in numbers)


if __name__ == "__main__":
    launch(main, Args)
