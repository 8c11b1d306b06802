"""Methods on test robots: replicates run in parallel, each is stored as soon as it ends and skipped the next time."""

from __future__ import annotations

import math
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import tyro
from joblib import delayed
from rich.console import Console
from tqdm import tqdm

from benchmarks.methods import METHODS, Method
from benchmarks.reporting.registry import experiment_named
from benchmarks.reporting.report import show
from benchmarks.results import Result, load, provenance, store
from benchmarks.task import Task
from famle_agent.utils.parallel import Backend, as_completed, parallel

Args = TypeVar("Args")


class ReplicateError(RuntimeError):
    """A replicate failed."""


@dataclass(frozen=True)
class Execution:
    """How replicates are run, and where results and agents are kept."""

    jobs: int = 2
    """Batches of replicates that run at the same time."""
    backend: Backend = "loky"
    """Where they run: in processes on this machine, or in a Ray cluster (RAY_ADDRESS, or one that is started here)."""
    out: Path = Path("benchmarks/results")
    """Folder of the results."""
    cache: Path = Path("runs/agents")
    """Folder of the agents that are learnt in simulation."""


@dataclass(frozen=True)
class Options(Execution):
    """What benchmarks that compare methods can be told. Each runs what is not stored, then reports on all that is."""

    methods: tuple[str, ...] = ()
    """Entries of benchmarks.methods.METHODS; by default those of the experiment in reporting/experiments.yaml."""
    replicates: int = 10
    """Seeds 0, 1, ..."""
    in_step: int = 30
    """Replicates of one method that act in step at most, where its robots can do that; they are stored together."""
    device: str = "cpu"
    """Where agents compute; their networks are learnt on the CPU."""
    minutes: float = math.inf
    """Wall time after which learning curves end with their episode; the report's title says how long they are."""


@dataclass(frozen=True)
class Batch:
    """Replicates of one method that run together: one, or many whose robots act in step.

    Attributes:
        method: What is run.
        seeds: Of the replicates.
        run: Makes the result of each; picklable, and alone responsible for its random numbers.
    """

    method: str
    seeds: tuple[int, ...]
    run: Callable[[], list[Result]]


def launch(main: Callable[[Args], object], arguments: type[Args], args: list[str] | None = None) -> None:
    """Runs a benchmark with the arguments of the command line; a mistake ends with advice and the status 2.

    Args:
        main: The benchmark.
        arguments: What it can be told.
        args: The command line without the program's name; None takes the process's own.
    """
    try:
        main(tyro.cli(arguments, args=args))
    except (ImportError, OSError, ReplicateError, TypeError, ValueError) as error:
        Console(stderr=True).print(str(error), markup=False, highlight=False)
        sys.exit(2)


def run_experiment(
    name: str,
    tasks: Sequence[Task],
    run: Callable[[str, Sequence[Task]], list[Result]],
    options: Options,
    known: Mapping[str, Method] = METHODS,
    together: bool = False,
) -> None:
    """Runs an experiment of the report, but for what is stored, and prints its section; see :func:`compare`."""
    methods = options.methods or experiment_named(name).methods
    compare(methods, tasks, run, options.out / f"{name}.csv", options, known, together)
    show(options.out, name)


def compare(
    methods: Sequence[str],
    tasks: Sequence[Task],
    run: Callable[[str, Sequence[Task]], list[Result]],
    table: Path,
    options: Options,
    known: Mapping[str, Method] = METHODS,
    together: bool = False,
) -> None:
    """Runs every method on every test robot, but for what is stored.

    Args:
        methods: What is compared.
        tasks: One test robot a replicate.
        run: Makes the results of a method and some tasks.
        table: Where the results go.
        options: How they are run.
        known: All methods by name.
        together: Whether robots of methods that can act in step do so; else ``run`` is given one task at a time.

    Raises:
        ValueError: A method is unknown.
        ReplicateError: A replicate failed, or what a method learns in simulation; all others have run and are stored.
    """
    if unknown := [method for method in methods if method not in known]:
        raise ValueError(f"There is no method {unknown[0]!r}. Methods: {', '.join(known)}.")
    failures = list[ReplicateError]()
    for method in methods:
        size = options.in_step if together and known[method].fleet is not None else 1
        groups = [tasks[i : i + size] for i in range(0, len(tasks), size)]
        batches = [Batch(method, tuple(task.seed for task in group), partial(run, method, group)) for group in groups]
        try:
            if _missing(batches, table):
                _learn(method, known[method], tasks[0], options)
            run_batches(batches, table, options.jobs, options.backend)
        except ReplicateError as error:
            failures.append(error)
    if failures:
        raise failures[0]


def run_batches(batches: Iterable[Batch], table: Path, jobs: int, backend: Backend = "loky") -> None:
    """Runs what is not stored yet; of a batch, all replicates where one is missing.

    Args:
        batches: What to run.
        table: Where the results go.
        jobs: Batches that run at the same time.
        backend: Where they run.

    Raises:
        ReplicateError: A replicate failed, and all others have run and are stored; or what was stored is gone.
    """
    todo = _missing(batches := list(batches), table)
    if not todo:
        return
    failures = list[str]()
    with parallel(backend), tqdm(total=len(todo), desc=table.stem, unit="batch") as bar:
        origin = provenance(sys.argv)  # of the code that runs, whatever is committed meanwhile
        for method, outcome in as_completed((delayed(_run)(batch) for batch in todo), jobs):
            if isinstance(outcome, str):
                failures.append(outcome)
            else:
                store(table, [result | origin for result in outcome])
            bar.set_postfix_str(method)
            bar.update()
    if failures:
        raise ReplicateError(f"A replicate failed; the others are stored.\n{failures[0]}")
    if _missing(batches, table):
        raise ReplicateError(f"{table} has lost rows while others came: somebody has removed it. Run it again.")


def _missing(batches: Iterable[Batch], table: Path) -> list[Batch]:
    """Lists the batches of which a replicate is not stored."""
    stored = set[tuple[str, int]]()
    if table.exists():
        results = load(table)
        stored.update(zip(results["method"], results["seed"], strict=True))
    return [batch for batch in batches if not {(batch.method, seed) for seed in batch.seeds} <= stored]


def _learn(name: str, method: Method, task: Task, options: Options) -> None:
    """Learns what the replicates share, once, before they want it in their processes."""
    try:
        with parallel(options.backend):
            method.learn(task)
    except Exception as error:
        raise ReplicateError(f"{name} could not be learnt, its replicates have not run: {error}") from error


def _run(batch: Batch) -> tuple[str, list[Result] | str]:
    """Makes the results, or the traceback of what was raised instead: one that fails must not end the others."""
    import torch

    torch.set_num_threads(1)  # replicates that run at the same time share the cores
    start = time.perf_counter()
    try:
        results = dict(zip(batch.seeds, batch.run(), strict=True))
    except Exception:
        return batch.method, f"{batch.method}, seed {batch.seeds[0]}: {traceback.format_exc()}"
    shared = {"wall_seconds": time.perf_counter() - start} | ({"fleet": len(results)} if len(results) > 1 else {})
    return batch.method, [{"method": batch.method, "seed": seed} | shared | result for seed, result in results.items()]
