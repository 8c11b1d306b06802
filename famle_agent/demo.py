"""A robot breaks and recovers: meta-learn, break, adapt, and show it."""

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
from stable_baselines3.common.logger import Logger, configure

from famle_agent.agent import ModelBasedAgent
from famle_agent.contest import with_and_without_adaptation
from famle_agent.dashboard import encode_gif, log_adaptations, log_gif, log_posterior
from famle_agent.famle import FAMLE
from famle_agent.plots import plot_returns, side_by_side
from famle_agent.robots import known_robots
from famle_agent.wrapper import FAMLEWrapper

__all__ = ["Episode", "run_demo", "run_episode"]

Frame = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Episode:
    """What happened in one episode.

    Attributes:
        total: Its return.
        situation: The most likely training situation at its end.
        probability: How likely that one is among them.
        seconds: Wall time per step, planning and adaptation included.
        frames: Pictures of the robot, where they were asked for.
    """

    total: float
    situation: str
    probability: float
    seconds: float
    frames: list[Frame] = field(default_factory=list)


def run_episode(
    env: FAMLEWrapper, seed: int | None = None, film: bool = False, logger: Logger | None = None
) -> Episode:
    """Runs the wrapped agent in its environment until the episode ends.

    Args:
        env: The environment of an agent.
        seed: Seed of the reset.
        film: Whether to keep a picture of each step; the environment needs ``render_mode="rgb_array"``.
        logger: Where the reward and the posterior of each step go.
    """
    obs, info = env.reset(seed=seed)
    total, seconds, steps, frames = 0.0, 0.0, 0, []
    done = False
    while not done:
        start = time.perf_counter()
        action, _ = env.agent.predict(obs)
        obs, reward, terminated, truncated, info = env.step(action)
        seconds += time.perf_counter() - start
        total, steps, done = total + float(reward), steps + 1, terminated or truncated
        if film:
            frames.append(np.asarray(env.render()))
        if logger is not None:
            env.agent.num_timesteps += 1
            logger.record("step/reward", float(reward))
            log_posterior(logger, env.agent.marginals())
            log_adaptations(logger, env.agent.belief)
            logger.dump(env.agent.num_timesteps)
    belief = info["famle"]
    return Episode(total, belief["situation"], belief["probability"], seconds / steps, frames)


def run_demo(
    robot: str = "reacher",
    situation: str = "paper",
    episodes: int = 5,
    out: Path = Path("demo"),
    seed: int = 0,
    **overrides: Any,
) -> dict[str, list[Episode]]:
    """Meta-learns from scratch, runs one intact episode, breaks the robot, and compares with and without adaptation.

    Args:
        robot: The robot's name.
        situation: What breaks: a preset or a description.
        episodes: Episodes after the break.
        out: Folder for the agent, the curve, the film and TensorBoard.
        seed: Seed of everything.
        **overrides: Settings to change.

    Returns:
        The episodes, the intact one first, by the name of the agent.

    Raises:
        ValueError: The robot or the situation is unknown.
    """
    console = Console()
    agent = FAMLE(robot, seed=seed, tensorboard_log=str(out / "tensorboard"), **overrides)
    env_id = known_robots()[robot].env_id
    probe = gym.make(env_id, situation=situation)  # a wrong name should fail before minutes of learning
    probe.close()
    out.mkdir(parents=True, exist_ok=True)
    console.print(f"[bold]FAMLE on {robot}[/bold]: meta-learning in simulation, then {situation!r} breaks it.")
    start = time.perf_counter()
    agent.meta_learn(progress_bar=True)
    console.print(f"Meta-learned {len(agent.situations)} situations in {time.perf_counter() - start:.0f} s.")
    results = {}
    for name, who in with_and_without_adaptation(agent, out).items():
        logger = configure(str(out / "tensorboard" / name.replace(" ", "_")), ["tensorboard"])
        with console.status(f"Running {name} ..."):
            results[name] = _run(who, env_id, situation, episodes, seed, logger)
        logger.close()
    console.print(_table(results))
    _write(results, out, f"{env_id}: {probe.get_wrapper_attr('situation')}", probe.metadata["render_fps"])
    console.print(
        f"Written to {out}/: returns.png, robot.gif, agent.zip; see also tensorboard --logdir {out}/tensorboard"
    )
    return results


def _run(
    agent: ModelBasedAgent, env_id: str, situation: str, episodes: int, seed: int, logger: Logger
) -> list[Episode]:
    env = FAMLEWrapper(gym.make(env_id, render_mode="rgb_array"), agent)
    agent.num_timesteps = 0
    results = [run_episode(env, seed, film=True, logger=logger)]
    env.get_wrapper_attr("set_situation")(situation)
    for i in range(episodes):
        results.append(run_episode(env, film=i in (0, episodes - 1), logger=logger))
        logger.record("episode/return", results[-1].total)
        logger.dump(agent.num_timesteps)
    log_gif(logger, "robot/last_episode", results[-1].frames, env.metadata["render_fps"], agent.num_timesteps)
    env.close()
    return results


def _table(results: dict[str, list[Episode]]) -> Table:
    table = Table("episode", *(f"return {name}" for name in results), "the robot believes", "per step")
    adapting = next(iter(results.values()))
    for i, rows in enumerate(zip(*results.values(), strict=True)):
        table.add_row(
            f"{i} (broken)" if i else "0 (intact)",
            *(f"{row.total:.1f}" for row in rows),
            f"{adapting[i].situation} ({adapting[i].probability:.0%})",
            f"{1000 * adapting[i].seconds:.0f} ms",
        )
    return table


def _write(results: dict[str, list[Episode]], out: Path, title: str, fps: float) -> None:
    plot_returns({name: [row.total for row in rows] for name, rows in results.items()}, title, out / "returns.png")
    adapting, frozen = results.values()
    films = {
        "intact": adapting[0].frames,
        "broken, without adaptation": frozen[-1].frames,
        "broken, with adaptation": adapting[-1].frames,
    }
    (out / "robot.gif").write_bytes(encode_gif(side_by_side(films), fps))
