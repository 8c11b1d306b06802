"""Methods on test robots: what every benchmark of robots does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from benchmarks.harness import Options, Replicate, Result, run_replicates
from benchmarks.methods import METHODS, Method, Task

__all__ = ["compare"]


def compare(
    methods: Sequence[str],
    tasks: Sequence[Task],
    run: Callable[[str, Task], Result],
    folder: Path,
    options: Options,
    known: Mapping[str, Method] = METHODS,
) -> None:
    """Runs every method on every test robot, but for what is stored.

    Args:
        methods: What is compared.
        tasks: One test robot a replicate.
        run: Makes the result of a method and a task.
        folder: Where the results go.
        options: How they are run.
        known: All methods by name.

    Raises:
        ValueError: A method is unknown.
    """
    for method in methods:
        if method not in known:
            raise ValueError(f"There is no method {method!r}. Methods: {', '.join(known)}.")
    for method in methods:
        replicates = [Replicate(method, task.seed, partial(run, method, task)) for task in tasks]
        if not all(replicate.path(folder).exists() for replicate in replicates):
            known[method].learn(tasks[0])  # once, before the replicates want it in their processes
        run_replicates(replicates, folder, options.jobs, options.backend)
