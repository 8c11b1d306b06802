"""Running an agent on its robot for an episode, with a fault that may strike on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from famle_agent.agents.wrapper import FAMLEWrapper

__all__ = ["Frames", "Rollout", "rollout", "running_mean"]

Floats = npt.NDArray[np.float64]
Frames = Sequence[npt.NDArray[np.uint8]]


@dataclass(frozen=True)
class Rollout:
    """Records one episode of an agent on its robot.

    Attributes:
        reward: Of each step, (n,).
        position: x and y of the robot's body in m before the first step and after each, (n + 1, 2); (n + 1, 0) of a
            robot that does not name its ``position``.
        plan_seconds: Wall time of planning in each step, (n,).
        step_seconds: Wall time of the whole step, planning, adaptation and the robot included, (n,).
        situations: The most likely situation after each step.
        probability: How likely the last of them is.
        breaks_at: The step before which the situation changed; None where it did not.
        success: Whether the robot reached its goal, where it has one.
        terminated: Whether the episode ended by itself, before its time was over.
        frames: Pictures, where they were asked for.
    """

    reward: Floats
    position: Floats
    plan_seconds: Floats
    step_seconds: Floats
    situations: list[str]
    probability: float
    breaks_at: int | None = None
    success: bool = False
    terminated: bool = False
    frames: Frames = field(default_factory=list)

    @property
    def steps(self) -> int:
        """The number of steps n."""
        return len(self.reward)

    @property
    def total(self) -> float:
        """The return."""
        return float(self.reward.sum())

    @property
    def fell(self) -> bool:
        """Whether the episode ended by itself and not at a goal."""
        return self.terminated and not self.success

    def recovery(self, threshold: float, window: int = 100) -> int | None:
        """Counts the steps from the break until the mean reward of the last ``window`` ones is above a threshold again.

        Returns:
            0 where it never falls to the threshold; None where it does not come back.
        """
        above = running_mean(self.reward, window)[self.breaks_at or 0 :] > threshold
        if above.all():
            return 0
        again = np.flatnonzero(above & (np.cumsum(~above) > 0))
        return int(again[0]) + 1 if len(again) else None


def rollout(
    env: FAMLEWrapper,
    seed: int | None = None,
    situation: Any = None,
    breaks_at: int | None = None,
    film_every: int = 0,
    on_step: Callable[[int, float], object] = lambda step, reward: None,
) -> Rollout:
    """Runs the wrapped agent until the episode ends.

    Args:
        env: The environment of an agent.
        seed: Seed of the reset.
        situation: What is wrong with the robot from ``breaks_at`` on.
        breaks_at: The step before which it strikes, 0 for the first; None changes nothing.
        film_every: Steps from picture to picture, 0 for none; the environment needs ``render_mode="rgb_array"``.
        on_step: Called with the number of each step and its reward, outside of the time that is taken.
    """
    obs, info = env.reset(seed=seed)
    rewards, plans, steps, situations, frames = list[float](), list[float](), list[float](), list[str](), []
    positions, done, terminated = [_position(env)], False, False
    while not done:
        if len(rewards) == breaks_at:
            env.get_wrapper_attr("set_situation")(situation)
        start = time.perf_counter()
        action, _ = env.agent.predict(obs)
        planned = time.perf_counter()
        obs, reward, terminated, truncated, info = env.step(action)
        steps.append(time.perf_counter() - start)
        plans.append(planned - start)
        rewards.append(float(reward))
        positions.append(_position(env))
        situations.append(info["famle"]["situation"])
        if film_every and (len(rewards) - 1) % film_every == 0:
            frames.append(np.asarray(env.render()))
        on_step(len(rewards) - 1, float(reward))
        done = terminated or truncated
    return Rollout(
        np.array(rewards),
        np.array(positions, dtype=np.float64),
        np.array(plans),
        np.array(steps),
        situations,
        info["famle"]["probability"],
        breaks_at,
        bool(info.get("is_success", False)),
        terminated,
        frames,
    )


def running_mean(values: npt.NDArray[Any], window: int) -> npt.NDArray[Any]:
    """Computes the mean of the last ``window`` values at each place, of fewer where there are not as many yet."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    end = np.arange(1, len(values) + 1)
    start = np.maximum(0, end - window)
    mean: npt.NDArray[Any] = (total[end] - total[start]) / (end - start)
    return mean


def _position(env: FAMLEWrapper) -> Any:
    return env.get_wrapper_attr("position")[:2] if env.has_wrapper_attr("position") else ()
