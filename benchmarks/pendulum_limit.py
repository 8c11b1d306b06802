"""The best that anybody can get from the pendulums of `benchmarks.gym_robots`, by dynamic programming.

python -m benchmarks.pendulum_limit
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from benchmarks.gym_robots import BEDS

STEPS, PERIOD, GRAVITY, TORQUE, SPEED = 200, 0.05, 10.0, 2.0, 8.0
"""Of Gymnasium's Pendulum-v1."""


def best_return(mass: float, length: float, states: int = 201, torques: int = 11) -> float:
    """Computes the largest return of 200 steps from rest below, by value iteration on a grid.

    Args:
        mass: In kg.
        length: In m.
        states: Angles, and speeds, of the grid.
        torques: Torques to choose from, evenly spaced.
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


def main() -> None:
    """Prints the largest return of each unseen pendulum."""
    for name, make in BEDS["pendulum"]().test.items():
        pendulum = make().unwrapped
        print(f"{name}: {best_return(pendulum.m, pendulum.l):.0f}", flush=True)  # type: ignore[attr-defined]


if __name__ == "__main__":
    main()
