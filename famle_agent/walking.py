"""A robot that breaks in the middle of a run: the run itself, and the demo that shows it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.logger import configure

from famle_agent.agent import ModelBasedAgent
from famle_agent.contest import with_and_without_adaptation
from famle_agent.dashboard import encode_gif, log_adaptations, log_gif, log_posterior
from famle_agent.famle import FAMLE
from famle_agent.plots import Frames, plot_speed, running_mean, side_by_side
from famle_agent.robots import known_robots
from famle_agent.wrapper import FAMLEWrapper

__all__ = ["BrokenRun", "run_and_break", "run_walking_demo"]

_FILM_FPS = 10


@dataclass(frozen=True)
class BrokenRun:
    """A run in which the robot broke.

    Attributes:
        speed: Reward of each step, a forward velocity in m/s, (steps,).
        seconds: Wall time of each step, adaptation and planning included, (steps,).
        believed: The most likely situation after each step.
        break_at: The first step of the broken robot.
        frames: Pictures, where they were asked for.
    """

    speed: npt.NDArray[np.float64]
    seconds: npt.NDArray[np.float64]
    believed: list[str]
    break_at: int
    frames: Frames = field(default_factory=list)

    def recovery(self, threshold: float, window: int = 100) -> int | None:
        """Steps from the break until the mean speed over the last ``window`` steps is above the threshold again.

        0 where it never falls to the threshold; None where it does not come back.
        """
        above = running_mean(self.speed, window)[self.break_at :] > threshold
        if above.all():
            return 0
        again = np.flatnonzero(above & (np.cumsum(~above) > 0))
        return int(again[0]) + 1 if len(again) else None


def run_and_break(
    env: FAMLEWrapper, situation: Any, steps: int, break_at: int, seed: int | None = None, film_every: int = 0
) -> BrokenRun:
    """Runs the wrapped agent and breaks its robot on the way.

    Args:
        env: The environment of an agent; it must be able to run for ``steps``.
        situation: What breaks.
        steps: Length of the run.
        break_at: The first step of the broken robot.
        seed: Seed of the reset.
        film_every: Steps from picture to picture, 0 for none; the environment needs ``render_mode="rgb_array"``.
    """
    obs, info = env.reset(seed=seed)
    speed, seconds, believed, frames = np.zeros(steps), np.zeros(steps), list[str](), []
    for t in range(steps):
        if t == break_at:
            env.get_wrapper_attr("set_situation")(situation)
        start = time.perf_counter()
        action, _ = env.agent.predict(obs)
        obs, reward, _, _, info = env.step(action)
        seconds[t], speed[t] = time.perf_counter() - start, reward
        believed.append(info["famle"]["situation"])
        if film_every and t % film_every == 0:
            frames.append(np.asarray(env.render()))
    return BrokenRun(speed, seconds, believed, break_at, frames)


def run_walking_demo(
    robot: str = "ant",
    situation: str = "joint 2 dead, yaw sensor off by 60 deg",
    out: Path = Path("demo"),
    seed: int = 0,
    steps: int = 900,
    break_at: int = 300,
    **overrides: Any,
) -> dict[str, BrokenRun]:
    """Breaks a running robot, and shows its speed before, at and after that, with adaptation and without.

    Args:
        robot: The robot's name; its shipped model is used, or one is meta-learned where none is shipped.
        situation: What breaks: a preset or a description.
        out: Folder for the plot, the film and TensorBoard.
        seed: Seed of the robot and the planner.
        steps: Length of the run.
        break_at: The first step of the broken robot.
        **overrides: Settings to change.

    Returns:
        The runs by the name of the agent.

    Raises:
        ValueError: The robot or the situation is unknown, or the break comes too late to be seen.
    """
    if not 0 < break_at < steps:
        raise ValueError(f"break_at must lie within the run of {steps} steps, got {break_at}.")
    console, env_id = Console(), known_robots()[robot].env_id
    gym.make(env_id, situation=situation).close()  # a wrong name should fail before minutes of learning
    agent = FAMLE(robot, seed=seed, **overrides)
    agents = with_and_without_adaptation(agent, out)

    env = gym.make(env_id, render_mode="rgb_array", max_episode_steps=steps)
    runs = {}
    for name, who in agents.items():
        with console.status(f"{robot} runs {name} ..."):
            runs[name] = _run(who, env, situation, steps, break_at, seed, out / "tensorboard" / name.replace(" ", "_"))
    rate = 1.0 / env.get_wrapper_attr("control_period")
    console.print(f"[bold]{env_id}[/bold] at {rate:.0f} Hz; after {break_at / rate:.1f} s: {situation}.")
    console.print(_table(runs, rate))
    plot_speed({name: run.speed for name, run in runs.items()}, break_at, rate, situation, out / "speed.png")
    films = side_by_side({name: run.frames for name, run in runs.items()})
    (out / "robot.gif").write_bytes(encode_gif(films, _FILM_FPS))
    console.print(
        f"Written to {out}/: speed.png, robot.gif, agent.zip; see also tensorboard --logdir {out}/tensorboard"
    )
    env.close()
    return runs


def _run(
    agent: ModelBasedAgent, env: gym.Env[Any, Any], situation: str, steps: int, break_at: int, seed: int, log: Path
) -> BrokenRun:
    agent.set_random_seed(seed)
    env.reset(options={"situation": None})
    film_every = max(1, round(1.0 / env.get_wrapper_attr("control_period") / _FILM_FPS))
    run = run_and_break(FAMLEWrapper(env, agent), situation, steps, break_at, seed, film_every)
    logger = configure(str(log), ["tensorboard"])
    for t, speed in enumerate(running_mean(run.speed, 30)):
        logger.record("step/speed", speed)
        logger.dump(t)
    log_posterior(logger, agent.marginals())
    log_adaptations(logger, agent.belief)
    log_gif(logger, "robot/run", run.frames, _FILM_FPS, steps)
    logger.close()
    return run


def _table(runs: dict[str, BrokenRun], rate: float) -> Table:
    second = round(rate)
    table = Table("mean speed (m/s)", *runs)
    run = next(iter(runs.values()))
    parts = {
        "last second before the break": slice(max(0, run.break_at - second), run.break_at),
        "first second after it": slice(run.break_at, run.break_at + second),
        "second second after it": slice(run.break_at + second, run.break_at + 2 * second),
        "last second": slice(-second, None),
    }
    for name, part in parts.items():
        table.add_row(name, *(f"{run.speed[part].mean():.2f}" if run.speed[part].size else "" for run in runs.values()))
    table.add_row("believes at the end", *(run.believed[-1] for run in runs.values()))
    table.add_row("... for the last", *(f"{_constant_tail(run.believed) / rate:.2f} s" for run in runs.values()))
    table.add_row("one step", *(f"{1e3 * np.median(run.seconds):.0f} ms" for run in runs.values()))
    return table


def _constant_tail(values: list[str]) -> int:
    """How many values at the end are the same."""
    return next((i for i, value in enumerate(reversed(values)) if value != values[-1]), len(values))
