"""A robot that walks a gait at a time across a floor: the run itself, and the demo that shows it."""

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
from famle_agent.plots import Frames, plot_paths, side_by_side
from famle_agent.robots import known_robots
from famle_agent.wrapper import FAMLEWrapper

__all__ = ["Journey", "run_journey", "run_journey_demo"]

_FILM_FPS = 4


@dataclass(frozen=True)
class Journey:
    """An episode of a robot on a floor.

    Attributes:
        path: Where the body really was before the first action and after each, x and y in m, (n + 1, 2).
        seconds: Wall time of each plan, (n,); adapting, which the wrapper does after the action, is not in it.
        believed: The most likely situation after each action.
        reached: Whether the robot reached its goal, where it has one.
        fell: Whether the episode ended because the robot fell.
        frames: Pictures, where they were asked for.
    """

    path: npt.NDArray[np.float64]
    seconds: npt.NDArray[np.float64]
    believed: list[str]
    reached: bool
    fell: bool
    frames: Frames = field(default_factory=list)

    @property
    def gaits(self) -> int:
        """Actions taken."""
        return len(self.seconds)


def run_journey(
    env: FAMLEWrapper,
    seed: int | None = None,
    later: Any = None,
    strikes_at: int = 0,
    film: bool = False,
) -> Journey:
    """Runs one episode of the wrapped agent.

    Args:
        env: The environment of an agent.
        seed: Seed of the reset.
        later: A situation that the robot gets into on the way; None changes nothing.
        strikes_at: The action before which it does.
        film: Whether to take a picture after each action; the environment needs ``render_mode="rgb_array"``.
    """
    obs, info = env.reset(seed=seed)
    path, seconds, believed, frames = [env.get_wrapper_attr("position")[:2]], list[float](), list[str](), []
    terminated = truncated = False
    while not (terminated or truncated):
        if later is not None and len(seconds) == strikes_at:
            env.get_wrapper_attr("set_situation")(later)
        start = time.perf_counter()
        action, _ = env.agent.predict(obs)
        planned = time.perf_counter()
        obs, _, terminated, truncated, info = env.step(action)
        seconds.append(planned - start)
        path.append(env.get_wrapper_attr("position")[:2])
        believed.append(info["famle"]["situation"])
        if film:
            frames.append(np.asarray(env.render()))
    reached = bool(info.get("is_success", False))
    return Journey(np.array(path), np.array(seconds), believed, reached, terminated and not reached, frames)


def run_journey_demo(
    robot: str,
    situation: str = "",
    profile: str = "reality",
    out: Path = Path("demo"),
    seed: int = 0,
    **overrides: Any,
) -> dict[str, Journey]:
    """Sends a robot outside its simulator across the floor, with adaptation and without.

    Args:
        robot: The robot's name; its shipped model is used, or one is meta-learned where none is shipped.
        situation: What is wrong with it: a preset or a description; empty is the paper's where the robot has that.
        profile: What else differs from the simulator.
        out: Folder for the plot, the film and TensorBoard.
        seed: Seed of the robot and the planner.
        **overrides: Settings to change.

    Returns:
        The runs by the name of the agent.

    Raises:
        ValueError: The robot, the situation or the profile is unknown.
    """
    console, env_id = Console(), known_robots()[robot].env_id
    # A wrong name should fail before minutes of learning.
    env = gym.make(env_id, profile=profile, render_mode="rgb_array")
    env.get_wrapper_attr("set_situation")(situation or env.get_wrapper_attr("presets").get("paper"))
    agent = FAMLE(robot, seed=seed, **overrides)
    agents = with_and_without_adaptation(agent, out)

    runs = {}
    for name, who in agents.items():
        with console.status(f"{robot} walks {name} ..."):
            runs[name] = _run(who, env, seed, out / "tensorboard" / name.replace(" ", "_"))
    title = f"{env_id}, {env.get_wrapper_attr('situation').label}, profile {profile!r}"
    console.print(f"[bold]{title}[/bold]")
    console.print(_table(runs))
    goal = env.get_wrapper_attr("goal") if env.has_wrapper_attr("goal") else None
    plot_paths({name: run.path for name, run in runs.items()}, title, out / "path.png", goal)
    films = side_by_side({name: run.frames for name, run in runs.items()})
    (out / "robot.gif").write_bytes(encode_gif(films, _FILM_FPS))
    console.print(f"Written to {out}/: path.png, robot.gif, agent.zip; see also tensorboard --logdir {out}/tensorboard")
    env.close()
    return runs


def _run(agent: ModelBasedAgent, env: gym.Env[Any, Any], seed: int, log: Path) -> Journey:
    agent.set_random_seed(seed)
    run = run_journey(FAMLEWrapper(env, agent), seed, film=True)
    logger = configure(str(log), ["tensorboard"])
    for t, (x, y) in enumerate(run.path):
        logger.record("step/x", x)
        logger.record("step/y", y)
        logger.dump(t)
    log_posterior(logger, agent.marginals())
    log_adaptations(logger, agent.belief)
    log_gif(logger, "robot/run", run.frames, _FILM_FPS, run.gaits)
    logger.close()
    return run


def _table(runs: dict[str, Journey]) -> Table:
    table = Table("", *runs)
    table.add_row("gaits (1 s each)", *(str(run.gaits) for run in runs.values()))
    table.add_row("ends", *("at the goal" if run.reached else "fallen" if run.fell else "-" for run in runs.values()))
    table.add_row("way along x (m)", *(f"{run.path[-1, 0]:.2f}" for run in runs.values()))
    table.add_row("believes at the end", *(run.believed[-1] for run in runs.values()))
    table.add_row("one plan", *(f"{1e3 * np.median(run.seconds):.0f} ms" for run in runs.values()))
    return table
