"""Work that is killed, or that cannot store what it has done, and is asked for again: what becomes of it."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import resource
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from benchmarks.results import load
from benchmarks.runner import Batch, ReplicateError, run_batches
from famle_agent.agents import meta_training
from famle_agent.agents.famle import FAMLE
from famle_agent.data.collect import collect
from famle_agent.data.policies import make_held_uniform
from famle_agent.training.progress import Progress

__all__ = ["KINDS", "WORKS", "Outcome", "Work", "attempt"]

Work = Callable[[Path], str]
"""Does something, stores it in a folder as it comes, goes on from there, and returns a digest of what it ends with."""
NOBODY = 65534
CLEAR = (OSError, ReplicateError, ValueError)
SITUATIONS = ("intact", "joint 0 reversed", "joint 3 dead")
TINY: dict[str, Any] = {
    **{"transitions_per_situation": 40, "rounds": 1, "round_transitions": 8, "hidden": (16,), "members": 2},
    **{"joint_iterations": 8, "round_iterations": 6, "joint_batch_size": 32},
    **{"meta_iterations": 6, "meta_batch_size": 3},
    **{"horizon": 3, "candidates": 8, "planner_iterations": 2, "elites": 3},
}
"""Settings of an arm's agent that is learnt within seconds."""


# --- what is done -----------------------------------------------------------------------------------------------------


def meta_learning(folder: Path) -> str:
    """Meta-learns in two rounds, and stores how far it has got after every iteration."""
    vars(meta_training)["Progress"] = partial(Progress, every=0.0)
    agent = FAMLE("reacher", device="cpu", seed=0, **TINY).meta_learn(SITUATIONS, folder=folder)
    parameters = agent.get_parameters()
    values = [parameters[part][name] for part in sorted(parameters) for name in sorted(parameters[part])]
    return _digest(*(value.numpy(force=True).tobytes() for value in [*values, agent.generator.get_state()]))


def collecting(folder: Path) -> str:
    """Collects transitions of random actions."""
    makers = [partial(gym.make, "FamleReacher-v0", situation=situation) for situation in SITUATIONS]
    return collect(makers, SITUATIONS, 500, make_held_uniform(5), seed=0, folder=folder).digest()


def measuring(folder: Path) -> str:
    """Runs the replicates of a benchmark, and stores their results in a table."""
    table = folder / "table.csv"
    run_batches([Batch("random", (seed,), partial(_random_return, seed)) for seed in range(6)], table, jobs=1)
    return _digest(load(table)[["method", "seed", "total"]].to_csv().encode())


def _random_return(seed: int) -> list[dict[str, Any]]:
    env, rng, total = gym.make("FamleReacher-v0", max_episode_steps=200), np.random.default_rng(seed), 0.0
    env.reset(seed=seed)
    for _ in range(200):
        total += float(env.step(rng.uniform(-1.0, 1.0, 5).astype(np.float32))[1])
    env.close()
    return [{"total": total}]


def _digest(*contents: bytes) -> str:
    return hashlib.sha256(b"".join(contents)).hexdigest()


WORKS: dict[str, Work] = {
    "meta-learning": meta_learning,
    "collecting": collecting,
    "a benchmark's table": measuring,
}
"""What is interrupted, by name."""


# --- how it is interrupted --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What became of work in a process of its own.

    Attributes:
        digest: Of what it ended with; empty where it did not end.
        error: What it raised instead.
        seconds: How long it took.
    """

    digest: str = ""
    error: Exception | None = None
    seconds: float = 0.0


def attempt(
    work: Work, folder: Path, obstacle: Callable[[], object] | None = None, interrupt: Interrupt | None = None
) -> Outcome:
    """Does work in a process of its own.

    Args:
        work: What is done.
        folder: Where it stores that.
        obstacle: What stands in its way, called in the process.
        interrupt: What happens to it after some seconds.
    """
    context = multiprocessing.get_context("forkserver")  # which imports all this once
    context.set_forkserver_preload([__name__, "torch._dynamo", "pybullet", "mujoco"])
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_do, args=(work, folder, obstacle, theirs))
    process.start()
    theirs.close()
    if interrupt is not None:
        process.join(interrupt.after)
        interrupt.how(process, folder)
    outcome = Outcome()
    with suppress(EOFError):  # of a process that was killed
        outcome = ours.recv()
    process.join()
    return outcome


@dataclass(frozen=True)
class Interrupt:
    """What happens to work.

    Attributes:
        how: Is given the process and its folder.
        after: After how many seconds.
    """

    how: Callable[[Any, Path], object]
    after: float


def _do(work: Work, folder: Path, obstacle: Callable[[], object] | None, connection: Any) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # progress bars
    torch.set_num_threads(1)
    if obstacle is not None:
        with TemporaryDirectory() as elsewhere:
            work(Path(elsewhere))  # imports what it needs, which another user may not be allowed to read
        obstacle()
    start = time.perf_counter()
    try:
        outcome = Outcome(work(folder), seconds=time.perf_counter() - start)
    except Exception as error:
        outcome = Outcome(error=error)
    connection.send(outcome)


def _limit_files(size: int) -> None:
    """Lets no file become longer, as a disk does on which no more is left."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def _become_nobody() -> None:
    """Gives up the rights of root, who may write into read-only folders."""
    if os.geteuid() == 0:
        os.seteuid(NOBODY)


def _kill(process: Any, _: Path) -> None:
    process.kill()


def _remove(_: Any, folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


# --- what became of it ------------------------------------------------------------------------------------------------


def killed(work: Work, folder: Path, whole: Outcome, chance: float) -> str:
    """Kills work at some moment (``kill -9``) and asks for it again.

    Args:
        work: What is done.
        folder: An empty folder.
        whole: What comes of it when nobody interrupts.
        chance: The moment, from 0 to 1.

    Returns:
        What went wrong; nothing where it ended with the very same bits.
    """
    attempt(work, folder, interrupt=Interrupt(_kill, chance * whole.seconds))
    return _other(attempt(work, folder), whole)


def full_disk(work: Work, folder: Path, whole: Outcome, chance: float) -> str:
    """Lets a disk be full while work that was killed goes on, empties it, and asks for the work again."""
    attempt(work, folder, interrupt=Interrupt(_kill, 0.5 * whole.seconds))
    size = int(10 ** (1.0 + 3.5 * chance))  # up to 30 kB, which is more than some files have
    return _stopped(work, folder, whole, partial(_limit_files, size)) or _other(attempt(work, folder), whole)


def read_only(work: Work, folder: Path, whole: Outcome, chance: float) -> str:
    """Goes on with killed work in a folder that cannot be written, lifts that, and asks for the work again."""
    attempt(work, folder, interrupt=Interrupt(_kill, chance * whole.seconds))
    folder.mkdir(exist_ok=True)
    inside = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    for path in inside:
        path.chmod(0o555)
    wrong = _stopped(work, folder, whole, _become_nobody)
    for path in inside:
        path.chmod(0o755)
    return wrong or _other(attempt(work, folder), whole)


def vanished(work: Work, folder: Path, whole: Outcome, chance: float) -> str:
    """Removes the folder under work, and asks for it again; what is left must not be taken for something else."""
    first = attempt(work, folder, interrupt=Interrupt(_remove, chance * whole.seconds))
    if wrong := _unclear(first, whole):
        return wrong
    again = attempt(work, folder)
    if again.error is None:
        return _other(again, whole)
    shutil.rmtree(folder, ignore_errors=True)  # as the error says
    return _unclear(again, whole) or _other(attempt(work, folder), whole)


KINDS: dict[str, Callable[[Work, Path, Outcome, float], str]] = {
    "kill -9": killed,
    "full disk": full_disk,
    "read-only folder": read_only,
    "vanished folder": vanished,
}
"""Ways to interrupt work, by name."""


def _stopped(work: Work, folder: Path, whole: Outcome, obstacle: Callable[[], object]) -> str:
    """What goes wrong where an obstacle stops work: no clear error, or an older file that changes."""
    before = dict(_contents(folder))
    outcome = attempt(work, folder, obstacle)
    after = dict(_contents(folder))
    if lost := sorted(path.name for path in before.keys() & after.keys() if after[path] != before[path]):
        return "" if outcome.digest == whole.digest else f"{', '.join(lost)} is another"
    if partials := [path.name for path in after.keys() - before.keys() if path.suffix == ".partial"]:
        return f"{partials[0]} was left"
    return _unclear(outcome, whole)


def _contents(folder: Path) -> Iterator[tuple[Path, bytes]]:
    for path in folder.rglob("*"):
        if path.is_file() and path.suffix not in (".progress", ".csv"):  # which grow
            yield path, path.read_bytes()


def _other(outcome: Outcome, whole: Outcome) -> str:
    if outcome.error is not None:
        return f"{type(outcome.error).__name__}: {outcome.error}"
    return "" if outcome.digest == whole.digest else "it ended with other bits"


def _unclear(outcome: Outcome, whole: Outcome) -> str:
    return "" if isinstance(outcome.error, CLEAR) else _other(outcome, whole)
