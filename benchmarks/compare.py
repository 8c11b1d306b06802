"""Methods on test robots: what every benchmark of robots does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmarks.harness import Fleet, Options, Replicate, ReplicateError, Result, is_stored, run_replicates
from benchmarks.methods import METHODS, Method
from benchmarks.task import Task
from famle_agent.utils.parallel import parallel

__all__ = ["compare"]


def compare(
    methods: Sequence[str],
    tasks: Sequence[Task],
    run: Callable[[str, Task], Result],
    folder: Path,
    options: Options,
    known: Mapping[str, Method] = METHODS,
    run_fleet: Callable[[str, Sequence[Task]], list[Result]] | None = None,
) -> None:
    """Runs every method on every test robot, but for what is stored.

    Args:
        methods: What is compared.
        tasks: One test robot a replicate.
        run: Makes the result of a method and a task.
        folder: Where the results go.
        options: How they are run.
        known: All methods by name.
        run_fleet: Makes the results of a method and many tasks, for methods whose robots can act in step.

    Raises:
        ValueError: A method is unknown.
        ReplicateError: A replicate failed, or what a method learns in simulation; all others have run and are stored.
    """
    for method in methods:
        if method not in known:
            raise ValueError(f"There is no method {method!r}. Methods: {', '.join(known)}.")
    failure: ReplicateError | None = None
    for method in methods:
        replicates: list[Replicate | Fleet]
        if run_fleet is not None and known[method].fleet is not None:
            fleets = [tasks[i : i + options.in_step] for i in range(0, len(tasks), options.in_step)]
            replicates = [
                Fleet(method, tuple(task.seed for task in some), partial(run_fleet, method, some)) for some in fleets
            ]
        else:
            replicates = [Replicate(method, task.seed, partial(run, method, task)) for task in tasks]
        try:
            if not all(is_stored(some, folder) for some in replicates):
                _learn(method, known[method], tasks[0], options)
            run_replicates(replicates, folder, options.jobs, options.backend)
        except ReplicateError as error:
            failure = failure or error
    if failure is not None:
        raise failure


def _learn(name: str, method: Method, task: Task, options: Options) -> None:
    """Learns what the replicates share, once, before they want it in their processes."""
    try:
        with parallel(options.backend):
            method.learn(task)
    except Exception as error:
        raise ReplicateError(f"{name} could not be learnt, its replicates have not run: {error}") from error
