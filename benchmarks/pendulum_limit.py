"""The best that anybody can get from the pendulums of `benchmarks.gym_robots`, by dynamic programming.

python -m benchmarks.pendulum_limit
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from benchmarks.gym_robots import BEDS
from benchmarks.runner import launch

STEPS, PERIOD, GRAVITY, TORQUE, SPEED = 200, 0.05, 10.0, 2.0, 8.0
"""Of Gymnasium's Pendulum-v1."""


@dataclass(frozen=True)
class Args:
    """The best that anybody can get from the pendulums of benchmarks.gym_robots."""

    states: int = 201
    """Angles, and speeds, of the grid."""
    torques: int = 11
    """Torques to choose from, evenly spaced."""


def best_return(mass: float, length: float, states: int, torques: int) -> float:
    """Computes the largest return of 200 steps from rest below, by value iteration on a grid.

    Args:
        mass: In kg.
        length: In m.
        states: See :class:`Args`.
        torques: See :class:`Args`.
    """
    angle, speed = np.linspace(-np.pi, np.pi, states), np.linspace(-SPEED, SPEED, states)
    th, w, u = np.meshgrid(angle, speed, np.linspace(-TORQUE, TORQUE, torques), indexing="ij")  # (angle, speed, torque)
    cost = th**2 + 0.1 * w**2 + 0.001 * u**2
    acceleration = 1.5 * GRAVITY / length * np.sin(th) + 3.0 / (mass * length**2) * u
    w_next = np.clip(w + acceleration * PERIOD, -SPEED, SPEED)
    th_next = (th + w_next * PERIOD + np.pi) % (2 * np.pi)
    at = np.stack([th_next / (2 * np.pi), (w_next + SPEED) / (2 * SPEED)]) * (states - 1)
    left = np.zeros((states, states))  # the least cost of the steps that are left
    for _ in range(STEPS):
        left = (cost + map_coordinates(left, at, order=1)).min(axis=-1)
    return -float(left[0, states // 2])


def main(args: Args) -> None:
    """Prints the largest return of each unseen pendulum."""
    for name, make in BEDS["pendulum"]().test.items():
        pendulum = make().unwrapped
        best = best_return(pendulum.m, pendulum.l, args.states, args.torques)  # type: ignore[attr-defined]
        print(f"{name}: {best:.0f}", flush=True)


if __name__ == "__main__":
    launch(main, Args)
