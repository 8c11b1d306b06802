"""Showing that a robot breaks and recovers: the same agent with adaptation and without."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text
from stable_baselines3.common.logger import configure

from famle_agent.agents.checkpoint import check_writable
from famle_agent.agents.famle import FAMLE
from famle_agent.agents.presets import known_robots
from famle_agent.agents.wrapper import FAMLEWrapper
from famle_agent.app.plots import plot_paths, plot_returns, plot_speed, side_by_side
from famle_agent.monitoring.adaptation_log import AdaptationLog
from famle_agent.monitoring.tensorboard import encode_gif, log_gif, log_values, scalar
from famle_agent.rollout import Rollout, rollout

__all__ = ["DEMOS", "Demo", "run_demo"]

Runs = Mapping[str, Sequence[Rollout]]
"""The episodes of each agent, by its name."""

_FILM_FPS = 10.0
_STEPS_BETWEEN_LINES = 100


@dataclass(frozen=True)
class Demo:
    """What is shown of a robot.

    Attributes:
        situation: What breaks, unless somebody says otherwise.
        breaks_at: The episode and the step in it before which the robot breaks.
        episodes: How many there are.
        env: Arguments of the environment.
        picture: Draws the episodes into a file.
    """

    situation: str
    breaks_at: tuple[int, int]
    episodes: int
    picture: Callable[[Runs, gym.Env[Any, Any], Path], None]
    env: Mapping[str, Any] = field(default_factory=dict)


def run_demo(
    robot: str = "reacher", situation: str = "", out: Path = Path("demo"), seed: int = 0, **overrides: Any
) -> dict[str, list[Rollout]]:
    """Breaks a robot and runs it, with adaptation and without.

    Args:
        robot: The robot's name. Its shipped model is used, or one is meta-learned where none is shipped.
        situation: What breaks: a preset or a description; empty takes the robot's own.
        out: Folder for the agent, the picture, the film and TensorBoard. Where it holds something already, the next
            free name is taken: ``demo-2``, ``demo-3`` and so on.
        seed: Seed of everything.
        **overrides: Fields of the robot's :class:`Demo`, or settings of the agent.

    Returns:
        The episodes of each agent, by its name.

    Raises:
        ValueError: The robot, the situation or the break is unknown.
    """
    shown, settings = _demo_of(robot, overrides)
    situation, console = situation or shown.situation, Console()
    env = gym.make(known_robots()[robot].env_id, render_mode="rgb_array", **shown.env)
    try:
        # A wrong name or path, or a machine that cannot render, should fail before minutes of learning.
        env.unwrapped.set_situation(situation)  # type: ignore[attr-defined]
        out = _free_folder(out)
        check_writable(out / "agent.zip")
        env.reset(seed=seed)
        env.render()
        broken = str(env.get_wrapper_attr("situation"))
        _say(console, f"The {robot} breaks {_when(shown)}: {broken}.")
        agents = _with_and_without_adaptation(robot, seed, out, settings, console)
        runs: dict[str, list[Rollout]] = {}
        for name, agent in agents.items():
            _say(console, f"Running {name}.")
            folder = out / "tensorboard" / name.replace(" ", "_")
            runs[name] = _run(agent, env, situation, shown, seed, folder, console)
        console.print(_table(runs, robot, broken))
        shown.picture(runs, env, out)
        films = {name: [frame for run in episodes for frame in run.frames] for name, episodes in runs.items()}
        texts = {name: _captions(episodes, env, broken) for name, episodes in runs.items()}
        (out / "robot.gif").write_bytes(encode_gif(side_by_side(films, texts), _film_rate(env)))
    finally:
        env.close()
    written = ", ".join(sorted(path.name for path in out.iterdir() if path.is_file()))
    _say(console, f"Written to {out}/: {written}; see also tensorboard --logdir {out}/tensorboard")
    return runs


def _say(console: Console, text: str) -> None:
    """Prints one line as it is, so that a line of a redirected output is a line too."""
    console.print(Text(text), soft_wrap=True)


def _free_folder(wanted: Path) -> Path:
    """Returns the folder if it is new or empty, else the first free one of ``wanted-2``, ``wanted-3``, ...

    Raises:
        ValueError: The folder holds something, and has no name that a number could be added to.
    """
    folder, number = wanted, 1
    while folder.is_dir() and any(folder.iterdir()):
        if wanted.name in ("", ".."):
            raise ValueError(f"{wanted} holds something already; give the name of a new folder.")
        number += 1
        folder = wanted.with_name(f"{wanted.name}-{number}")
    return folder


def _demo_of(robot: str, overrides: Mapping[str, Any]) -> tuple[Demo, dict[str, Any]]:
    """Divides what somebody changed into the demo's part and the agent's."""
    if robot not in DEMOS:
        raise ValueError(f"There is a demo of {', '.join(DEMOS)}, not of {robot!r}.")
    own = {name: value for name, value in overrides.items() if name in ("breaks_at", "episodes", "env")}
    shown = replace(DEMOS[robot], **own)
    episode, step = shown.breaks_at
    limit = shown.env.get("max_episode_steps")
    if not 0 <= episode < shown.episodes or step < 0 or (limit is not None and step >= limit):
        within = f"{shown.episodes} episodes" + ("" if limit is None else f" of {limit} steps")
        raise ValueError(f"breaks_at, an episode and a step, must lie within {within}; got {shown.breaks_at}.")
    return shown, {name: value for name, value in overrides.items() if name not in own}


def _with_and_without_adaptation(
    robot: str, seed: int, out: Path, settings: Mapping[str, Any], console: Console
) -> dict[str, FAMLE]:
    agent = FAMLE(robot, seed=seed, tensorboard_log=str(out / "tensorboard"), **settings)
    if agent.dynamics is None:
        _say(console, f"FAMLE on {robot}: meta-learning in simulation.")
        start = time.perf_counter()
        agent.meta_learn(progress_bar=True, n_jobs=-1)
        _say(console, f"Meta-learned {len(agent.situations)} situations in {time.perf_counter() - start:.0f} s.")
    out.mkdir(parents=True, exist_ok=True)
    agent.save(out / "agent.zip")
    return {"with adaptation": agent, "without adaptation": FAMLE.load(out / "agent.zip", adapt_every=0)}


def _when(shown: Demo) -> str:
    episode, step = shown.breaks_at
    return f"before step {step} of episode {episode}" if step else f"before episode {episode}"


def _run(
    agent: FAMLE,
    env: gym.Env[Any, Any],
    situation: str,
    shown: Demo,
    seed: int,
    folder: Path,
    console: Console,
) -> list[Rollout]:
    """Runs the episodes of one agent, and logs what it goes through and the film of the last one."""
    agent.set_random_seed(seed)
    env.unwrapped.set_situation(None)  # type: ignore[attr-defined]
    logger, runs, done = configure(str(folder), ["tensorboard"]), list[Rollout](), 0
    log = AdaptationLog(agent, logger, share=1.0)
    wrapped = FAMLEWrapper(env, agent, log)
    for episode in range(shown.episodes):
        breaks_at = shown.breaks_at[1] if episode == shown.breaks_at[0] else None
        filmed = _film_every(env) if episode in (0, shown.breaks_at[0], shown.episodes - 1) else 0
        progress = _progress(wrapped, console)
        runs.append(rollout(wrapped, seed if episode == 0 else None, situation, breaks_at, filmed, progress))
        done += runs[-1].steps
        _say(console, f"  episode {episode}: {_outcome(runs[-1])}. {_belief_and_truth(wrapped)}")
        log_values(logger, [scalar("episode/return", runs[-1].total)], done)
    log.close()
    log_gif(logger, "robot/last_episode", runs[-1].frames, _film_rate(env), done)
    logger.close()
    return runs


def _progress(env: FAMLEWrapper, console: Console) -> Callable[[int, float], None]:
    def on_step(step: int, reward: float) -> None:
        if (step + 1) % _STEPS_BETWEEN_LINES == 0:
            _say(console, f"  step {step + 1}. {_belief_and_truth(env)}")

    return on_step


def _belief_and_truth(env: FAMLEWrapper) -> str:
    return f"Belief: {env.agent.diagnose()} Truth: {env.get_wrapper_attr('situation')}."


def _film_every(env: gym.Env[Any, Any]) -> int:
    """Steps from picture to picture of the film."""
    return max(1, round(1.0 / (float(env.get_wrapper_attr("control_period")) * _FILM_FPS)))


def _captions(runs: Sequence[Rollout], env: gym.Env[Any, Any], broken: str) -> list[str]:
    """Writes below each picture what is wrong with the robot, what the agent believes, and the return until then."""
    every, texts, truth = _film_every(env), list[str](), "intact"
    for run in runs:
        so_far = run.reward.cumsum()
        for step in range(0, every * len(run.frames), every):
            truth = broken if run.breaks_at is not None and step >= run.breaks_at else truth
            texts.append(f"truth: {truth}\nbelief: {run.situations[step]}\nreturn: {so_far[step]:.0f}")
        truth = truth if run.breaks_at is None else broken
    return texts


def _film_rate(env: gym.Env[Any, Any]) -> float:
    """Pictures per second of the film; a robot of one action a second is shown faster than it is."""
    return min(_FILM_FPS, max(4.0, 1.0 / float(env.get_wrapper_attr("control_period"))))


def _table(runs: Runs, robot: str, broken: str) -> Table:
    """One row an episode; of one that the robot breaks in, the rewards of a step before and after."""
    returns, title = [f"return {name}" for name in runs], Text(f"{robot}: {broken}")
    table = Table("episode", *returns, "truth at the end", "believes at the end", "per step", title=title)
    adapting = next(iter(runs.values()))
    breaks_in = next(i for i, run in enumerate(adapting) if run.breaks_at is not None)
    for i, run in enumerate(adapting):
        truth = broken if i >= breaks_in else "intact"
        cells = [_outcome(episodes[i]) for episodes in runs.values()]
        milliseconds = f"{1e3 * np.median(run.step_seconds):.0f} ms"
        table.add_row(str(i), *cells, Text(truth), Text(f"{run.situations[-1]} ({run.probability:.0%})"), milliseconds)
    return table


def _outcome(run: Rollout) -> str:
    ending = " at the goal" if run.success else " fell" if run.fell else ""
    parts = [f"{run.total:.1f} in {run.steps} steps{ending}"]
    if run.breaks_at:
        before, after = run.reward[: run.breaks_at].mean(), run.reward[run.breaks_at :].mean()
        parts.append(f"{before:.2f} a step before the break, {after:.2f} after")
    return ", ".join(parts)


# --- the robots -------------------------------------------------------------------------------------------------------


def _draw_returns(runs: Runs, env: gym.Env[Any, Any], out: Path) -> None:
    returns = {name: [run.total for run in episodes] for name, episodes in runs.items()}
    plot_returns(returns, f"{env.spec.id if env.spec else ''}", out / "returns.png")


def _draw_speed(runs: Runs, env: gym.Env[Any, Any], out: Path) -> None:
    speed = {name: episodes[-1].reward for name, episodes in runs.items()}
    broken = next(iter(runs.values()))[-1]
    rate = 1.0 / env.get_wrapper_attr("control_period")
    plot_speed(speed, broken.breaks_at or 0, rate, env.get_wrapper_attr("situation").label, out / "speed.png")


def _draw_path(runs: Runs, env: gym.Env[Any, Any], out: Path) -> None:
    paths = {name: episodes[-1].position for name, episodes in runs.items()}
    goal = env.get_wrapper_attr("goal") if env.has_wrapper_attr("goal") else None
    title = f"{env.get_wrapper_attr('situation').label}, profile {str(env.get_wrapper_attr('profile'))!r}"
    plot_paths(paths, title, out / "path.png", goal)


_TO_A_GOAL = Demo("paper", (0, 0), 1, _draw_path, {"profile": "held-out"})

DEMOS: Mapping[str, Demo] = {
    "reacher": Demo("paper", (1, 0), 6, _draw_returns),
    "ant": Demo("joint 2 dead, yaw sensor off by 60 deg", (0, 300), 1, _draw_speed, {"max_episode_steps": 900}),
    "quadruped": _TO_A_GOAL,
    "a1": _TO_A_GOAL,
    "minitaur": Demo("intact", (0, 0), 1, _draw_path, {"profile": "held-out"}),
}
"""What is shown of each robot."""
