"""What is lost, executed or leaked when things go wrong or last long: one table of what was tried, and what went wrong.

python -m benchmarks.robustness                                 # all parts, in a quarter of an hour
python -m benchmarks.robustness --parts control --steps 200000  # one of them, for longer

Kills, full disks, read-only and vanished folders under meta-learning, collection and a benchmark; damaged files for
each reader (benchmarks.fuzz searches longer); and memory, time, threads, open files and physics clients of control
steps with changing damage, of environments that are made and closed, and of learn() after learn(). Runs on Linux.
"""

from __future__ import annotations

import gc
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.fuzz import READERS, ReaderName
from benchmarks.interruptions import KINDS, SITUATIONS, TINY, WORKS, attempt
from benchmarks.results import provenance, store
from benchmarks.runner import launch
from famle_agent.agents.famle import FAMLE
from famle_agent.agents.presets import known_robots
from famle_envs.engines import ENGINES, MissingPackageError

GROWTH = 0.05
"""By how much of itself memory may grow from the second fifth of a long run to its last."""
SLOWER = 0.2
"""The same of the median processor time of a control step, which other work on the machine changes too."""


@dataclass(frozen=True)
class Args:
    """Tries what can go wrong, and tells what did."""

    parts: tuple[str, ...] = ("interruptions", "files", "control", "environments", "learning")
    """What is tried."""
    kills: int = 20
    """Moments at which each kind of work is killed."""
    others: int = 2
    """Moments at which a disk is full, a folder cannot be written, or it vanishes."""
    mutations: int = 500
    """Damaged inputs of each reader."""
    steps: int = 5000
    """Control steps of the ant; its damage changes every 100."""
    environments: int = 2000
    """Environments that are made and closed, all robots in all engines in turn."""
    learns: int = 200
    """Calls of learn()."""
    seed: int = 0
    """Of the moments and the inputs."""
    out: Path = Path("benchmarks/results")
    """Folder of robustness.csv."""

    def __post_init__(self) -> None:
        if unknown := set(self.parts) - set(PARTS):
            raise ValueError(f"There is no part {', '.join(unknown)}. Parts: {', '.join(PARTS)}.")


@dataclass
class Row:
    """What was tried.

    Attributes:
        tried: In words.
        cases: How often.
        wrong: What went wrong, a line each.
        figures: What was measured.
    """

    tried: str
    cases: int = 0
    wrong: list[str] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)


# --- nothing is lost --------------------------------------------------------------------------------------------------


def interruptions(args: Args) -> Iterator[Row]:
    """Interrupts each kind of work at moments drawn at random, and asks for it again."""
    rng = np.random.default_rng(args.seed)
    for what, work in WORKS.items():
        with TemporaryDirectory() as base:
            Path(base).chmod(0o755)  # so that another user could read it
            attempt(work, Path(base) / "first")  # which is slower than others
            whole = attempt(work, Path(base) / "whole")
            if not whole.digest:
                raise RuntimeError(f"{what} fails by itself: {whole.error}")
            for how, kind in KINDS.items():
                row = Row(f"{how}: {what}")
                for i in range(args.kills if how == "kill -9" else args.others):
                    wrong = kind(work, Path(base) / f"{how}-{i}", whole, rng.random())
                    row.cases += 1
                    row.wrong += [wrong] * bool(wrong)
                yield row


# --- nothing is executed ----------------------------------------------------------------------------------------------

EXECUTES = ("pickle.find_class", "os.system", "os.exec", "os.posix_spawn", "subprocess.Popen")
"""Events by which Python tells that something is unpickled, or that another program is run."""


def files(args: Args) -> Iterator[Row]:
    """Gives each reader inputs that were cut, mixed and changed at random."""
    executed = list[str]()
    sys.addaudithook(lambda event, _: executed.append(event) if event in EXECUTES else None)  # for good
    for name in READERS:
        with TemporaryDirectory() as folder:
            row = _damaged(name, Path(folder), args, executed)
        row.wrong += executed
        executed.clear()
        yield row


def _damaged(name: ReaderName, folder: Path, args: Args, executed: list[str]) -> Row:
    read, seeds = READERS[name](folder)
    executed.clear()  # of what was made to be read
    rng, row, slowest, before = np.random.default_rng(args.seed), Row(f"damaged input: {name}"), 0.0, _peak()
    for i in range(args.mutations):
        data = changed(seeds[i % len(seeds)], rng)
        start = time.perf_counter()
        try:
            read(data)
        except ValueError:
            pass
        except Exception as error:
            row.wrong.append(f"{type(error).__name__}: {error}")
        slowest = max(slowest, time.perf_counter() - start)
    row.cases = args.mutations
    row.figures = {"slowest (s)": slowest, "more memory (MB)": _peak() - before}
    return row


def changed(data: bytes, rng: np.random.Generator) -> bytes:
    """Changes some bytes, repeats a part, leaves one out, or cuts the end; all but the first byte."""
    content = bytearray(data[1:])
    start, end = sorted(int(place) for place in rng.integers(0, len(content) + 1, 2))
    kind = rng.integers(4)
    if kind == 0:
        for place in rng.integers(0, max(1, len(content)), int(rng.integers(1, 6))):
            content[place : place + 1] = rng.bytes(1)
    elif kind == 1:
        content[start:end] *= 2
    elif kind == 2:
        del content[start:end]
    else:
        del content[start:]
    return data[:1] + bytes(content)


# --- long runs --------------------------------------------------------------------------------------------------------


def control(args: Args) -> Iterator[Row]:
    """Lets the ant run, and changes what is wrong with it every 100 steps."""
    agent, rng = FAMLE("ant", seed=args.seed, device="cpu"), np.random.default_rng(args.seed)
    env: Any = gym.make("FamleAnt-v0")
    presets = list(env.unwrapped.presets.values())
    obs, _ = env.reset(seed=args.seed)
    state, start, row = None, np.array([True]), Row("control steps of the ant, with changing damage", args.steps)
    memory, seconds = np.zeros(args.steps), np.zeros(args.steps)
    for i in range(args.steps):
        if i % 100 == 0:
            env.unwrapped.set_situation(presets[rng.integers(len(presets))])
        before = time.process_time()
        action, state = agent.predict(obs, state, start)
        memory[i], seconds[i] = _memory(), time.process_time() - before
        if not (env.action_space.contains(action) and state.belief.h.isfinite().all()):
            row.wrong.append(f"step {i}: action {action}, embedding {state.belief.h}")
        obs, _, terminated, truncated, _ = env.step(action)
        start[:] = terminated or truncated
        if start[0]:
            obs, _ = env.reset()
    env.close()
    latency = _growth(seconds)
    row.figures = {"memory growth": _growth(memory), "latency growth": latency, "median (ms)": 1e3 * np.median(seconds)}
    row.wrong += _grown(memory) + [f"a step takes {latency:.0%} longer"] * (latency > SLOWER)
    yield row


def environments(args: Args) -> Iterator[Row]:
    """Makes robots in all engines that are installed, and closes them."""

    def once(env_id: str, engine: str, seed: int) -> None:
        env = gym.make(env_id, engine=engine)
        env.reset(seed=seed)
        env.step(env.action_space.sample())
        env.close()

    kinds = list[tuple[str, str]]()
    for env_id, engine in product([robot.env_id for robot in known_robots().values() if robot.env_id], ENGINES):
        with suppress(MissingPackageError):
            once(env_id, engine, seed=0)  # which reads what is read but once, such as meshes
            kinds.append((env_id, engine))
    row = repeated("make() and close()", args.environments, lambda i: once(*kinds[i % len(kinds)], seed=i))
    row.figures["robots, in each engine that they can run in here"] = len(kinds)
    yield row


def learning(args: Args) -> Iterator[Row]:
    """Learns on a robot again and again, with TensorBoard, by one agent and by many that are let go."""
    with TemporaryDirectory() as folder:
        agent = FAMLE("reacher", seed=args.seed, device="cpu", tensorboard_log=folder, **TINY).meta_learn(SITUATIONS)
        yield repeated("learn()", args.learns, lambda _: agent.learn(10))
        file = Path(folder) / "agent.zip"
        agent.save(file)

        def once(_: int) -> None:
            another = FAMLE.load(file)
            another.tensorboard_log = folder
            another.learn(10)
            another.get_env().close()  # type: ignore[union-attr]

        yield repeated("load() and learn()", args.learns, once)
    agent.get_env().close()  # type: ignore[union-attr]


PARTS: Mapping[str, Callable[[Args], Iterator[Row]]] = {
    "interruptions": interruptions,
    "files": files,
    "control": control,
    "environments": environments,
    "learning": learning,
}
"""What can be tried, by name."""


def repeated(tried: str, times: int, once: Callable[[int], object]) -> Row:
    """Does something again and again, and counts what is left of it each time; a fifth of the time fills caches.

    What is left counts where it grows in the first half of what follows and in the second one: a leak does so, and a
    cache that fills late does not.
    """
    gc.collect()  # or what others have left would go meanwhile, and hide what is left of this
    memory, held, looks = np.zeros(times), list[dict[str, int]](), (times // 5, 3 * times // 5, times - 1)
    for i in range(times):
        once(i)
        memory[i] = _memory()
        if i in looks:
            held.append(_held())
    first, middle, last = held
    more = {name: min(last[name] - middle[name], middle[name] - first[name]) for name in last}
    allowed = {"objects": times // 5}  # half of what is left in either part where each time leaves one
    leaked = [f"{number} more {name}, twice" for name, number in more.items() if number > allowed.get(name, 0)]
    row = Row(tried, times, leaked + _grown(memory), {"memory growth": _growth(memory)})
    row.figures |= {"MB before": _median(memory, 1), "MB after": _median(memory, 4)}
    for name in last:
        row.figures |= {f"{name} before": first[name], f"{name} after": last[name]}
    return row


def _held() -> dict[str, int]:
    """What this process has: threads, open files, objects of Python, and PyBullet's clients."""
    gc.collect()
    held = {"threads": len(os.listdir("/proc/self/task")), "files": len(os.listdir("/proc/self/fd"))}
    held["objects"] = len(gc.get_objects())
    if (bullet := sys.modules.get("pybullet")) is not None:
        held["clients"] = sum(bullet.isConnected(i) for i in range(1024))
    return held


def _memory() -> float:
    """What this process holds in memory, in MB, without pages of files, which the system drops as it likes."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines["RssAnon"].split()[0]) / 2**10


def _peak() -> float:
    """The most that this process has held, in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def _growth(values: npt.NDArray[np.float64]) -> float:
    """By how much of itself the median has grown from the second fifth to the last."""
    return _median(values, 4) / _median(values, 1) - 1.0


def _median(values: npt.NDArray[np.float64], fifth: int) -> float:
    """The median of one of five equal parts of a long run."""
    return float(np.median(np.array_split(values, 5)[fifth]))


def _grown(memory: npt.NDArray[np.float64]) -> list[str]:
    growth = _growth(memory)
    return [f"memory grew by {growth:.0%}"] * (growth > GROWTH)


# --- the table --------------------------------------------------------------------------------------------------------


def main(args: Args) -> None:
    """Tries all parts, stores and prints.

    Raises:
        ValueError: Something went wrong; all parts are stored and printed first.
    """
    torch.set_num_threads(1)
    origin, shown, wrong = provenance(sys.argv), Table("tried", "cases", "wrong", "measured"), list[str]()
    for part in args.parts:
        for row in PARTS[part](args):
            about = {"part": part, "figure": row.tried, "cases": row.cases, "wrong": len(row.wrong)}
            what = {"what": row.wrong[:5] or None, "measured": row.figures or None}
            store(args.out / "robustness.csv", [{**about, **what, **origin}], keys=("part", "figure"))
            measured = ", ".join(f"{name} {value:.3g}" for name, value in row.figures.items())
            shown.add_row(row.tried, f"{row.cases}", f"{len(row.wrong)}", measured)
            wrong += [f"{row.tried}: {line}" for line in row.wrong]
    Console(width=140).print(shown)
    if wrong:
        raise ValueError("\n".join(wrong))


if __name__ == "__main__":
    launch(main, Args)
