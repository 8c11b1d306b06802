"""``famle demo | meta-learn | run``.

What a command needs is imported when it runs, so that ``--help`` answers at once.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.console import Console

from famle_agent import __version__
from famle_agent.utils.errors import NotLearnedError

__all__ = ["main", "read_command"]


@dataclass(frozen=True)
class Demo:
    """Break a robot and watch it adapt: arm and ant in simulation, robots with gaits on held-out dynamics."""

    robot: Literal["reacher", "ant", "quadruped", "a1", "minitaur"] = "reacher"
    """The robot."""
    situation: str = ""
    """What breaks: a preset or a description such as "joint 0 reversed, joint 3 dead"; by default the robot's own."""
    episodes: int = 5
    """Episodes after the break, of the arm."""
    out: Path = Path("demo")
    """Folder for the results; where it holds something already, the next free one of demo-2, demo-3 and so on."""
    seed: int = 0
    """Seed of everything."""
    meta_iterations: int | None = None
    """Iterations of the arm's meta-learning, fewer are faster and worse; the other robots come with a model."""

    def __call__(self) -> None:
        """Runs the demo.

        Raises:
            ValueError: The situation is unknown, or a robot that comes with a model is told to learn another one.
        """
        if self.meta_iterations is not None and self.robot != "reacher":
            raise ValueError(f"The {self.robot} comes with a model; --meta-iterations is for the arm alone.")
        overrides: dict[str, Any] = {} if self.meta_iterations is None else {"meta_iterations": self.meta_iterations}
        if self.robot == "reacher":
            overrides["episodes"] = 1 + self.episodes  # the first one is intact
        from famle_agent.app.demo import run_demo

        run_demo(self.robot, self.situation, self.out, self.seed, **overrides)


@dataclass(frozen=True)
class MetaLearn:
    """Meta-learn an agent over its training situations and save it."""

    robot: str = "reacher"
    """A robot, or a Gymnasium id whose environment names its training situations."""
    out: Path = Path("agent.zip")
    """Where the agent goes."""
    mode: str = "ours"
    """"ours", "paper", or "original" where the authors' code has the robot."""
    seed: int = 0
    """Seed of everything."""
    jobs: int = -1
    """Processes that simulate, -1 for one a core."""
    backend: Literal["loky", "ray"] = "loky"
    """Where they run: on this machine, or in a Ray cluster (RAY_ADDRESS, or one that is started here)."""
    folder: Path | None = None
    """Folder for the transitions and the models on the way; the same command goes on where it was stopped."""
    tensorboard: Path | None = None
    """Folder for TensorBoard."""

    def __call__(self) -> None:
        """Meta-learns and saves."""
        from famle_agent.agents.checkpoint import check_writable
        from famle_agent.agents.famle import FAMLE
        from famle_agent.utils.parallel import parallel

        log = None if self.tensorboard is None else str(self.tensorboard)
        agent = FAMLE(self.robot, self.mode, seed=self.seed, tensorboard_log=log)
        check_writable(self.out)  # before all the learning
        with parallel(self.backend):
            agent.meta_learn(progress_bar=True, n_jobs=self.jobs, folder=self.folder)
        agent.save(self.out)
        _say(f"Saved {self.out}.")


@dataclass(frozen=True)
class Run:
    """Run a saved agent on a broken robot, adapting."""

    agent: Annotated[Path, tyro.conf.Positional]
    """The file of the agent."""
    situation: str = "intact"
    """What is wrong with the robot."""
    episodes: int = 5
    """Episodes to run."""
    seed: int = 0
    """Seed of the environment and the planner."""

    def __call__(self) -> None:
        """Runs the episodes and prints their returns."""
        import gymnasium as gym

        from famle_agent.agents.famle import FAMLE
        from famle_agent.agents.wrapper import FAMLEWrapper
        from famle_agent.rollout import rollout

        agent = FAMLE.load(self.agent)
        agent.set_random_seed(self.seed)
        robot = agent.get_env()
        if robot is None:
            raise ValueError(f"{self.agent} names no environment that can be made here; use FAMLE.load(path, env).")
        spec = robot.get_attr("spec")[0]
        arguments = {**spec.kwargs, "situation": self.situation}
        env = FAMLEWrapper(gym.make(spec.id, max_episode_steps=spec.max_episode_steps, **arguments), agent)
        for i in range(self.episodes):
            run = rollout(env, self.seed if i == 0 else None)
            _say(f"episode {i}: return {run.total:.1f}, believes {run.situations[-1]} ({run.probability:.0%})")
        env.close()


def main(args: list[str] | None = None) -> None:
    """Entry point of the command ``famle``.

    Args:
        args: The command line without the program's name; None takes the process's own. ``--version`` prints the
            version.
    """
    try:
        _run(sys.argv[1:] if args is None else args)
    except KeyboardInterrupt:
        _say("famle: stopped.", stderr=True)
        sys.exit(130)  # 128 and the number of the signal, as shells have it
    except (ImportError, OSError, NotLearnedError, TypeError, ValueError) as error:
        _say(f"famle: {error}", stderr=True)
        sys.exit(2)


def read_command(args: list[str]) -> Demo | MetaLearn | Run:
    """Reads a command line without its program's name; one that is wrong ends the process with advice."""
    command: Demo | MetaLearn | Run = tyro.extras.subcommand_cli_from_dict(
        {"demo": Demo, "meta-learn": MetaLearn, "run": Run}, args=args, prog="famle"
    )
    return command


def _run(args: list[str]) -> None:
    if args == ["--version"]:
        _say(f"famle {__version__}")
        return
    command = read_command(args)
    import torch

    if not isinstance(command, MetaLearn):
        # A plan's matrices are small: a second thread gains little, and waits long where the machine is busy.
        torch.set_num_threads(1)
    command()


def _say(text: str, stderr: bool = False) -> None:
    """Prints a text as it is: no markup, no emoji, and no line broken where the screen ends."""
    Console(stderr=stderr).print(text, markup=False, emoji=False, highlight=False, soft_wrap=True)
