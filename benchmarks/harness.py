"""Replicates: run in parallel, each stored as soon as it ends and skipped the next time."""

from __future__ import annotations

import json
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed
from tqdm import tqdm

from famle_agent.cluster import Backend, parallel

__all__ = ["Options", "Replicate", "Result", "load_results", "provenance", "run_replicates", "write_json"]

Result = dict[str, Any]
_PACKAGES = ("famle", "gymnasium", "matplotlib", "numpy", "pybullet", "scipy", "stable-baselines3", "torch")


@dataclass(frozen=True)
class Options:
    """What all benchmarks can be told. Each runs replicates that are not stored yet, then reports on all that are."""

    methods: tuple[str, ...] = ()
    """Entries of benchmarks.methods.METHODS; by default those that belong to the experiment."""
    replicates: int = 10
    """Seeds 0, 1, ..."""
    jobs: int = 2
    """Replicates that run at the same time."""
    backend: Backend = "loky"
    """Where they run: in processes on this machine, or in a Ray cluster (RAY_ADDRESS, or one that is started here)."""
    out: Path = Path("benchmarks/results")
    """Folder of the results."""
    cache: Path = Path("runs/agents")
    """Folder of the agents that are learnt in simulation."""


@dataclass(frozen=True)
class Replicate:
    """One seed of one method.

    Attributes:
        method: What is run.
        seed: Seed of its robot, and of what it learns for itself.
        run: Makes the result; picklable, and alone responsible for its seeds.
    """

    method: str
    seed: int
    run: Callable[[], Result]

    def path(self, folder: Path) -> Path:
        """Where the result is stored."""
        return folder / f"{self.method}-{self.seed}.json"


def run_replicates(replicates: Iterable[Replicate], folder: Path, jobs: int, backend: Backend = "loky") -> None:
    """Runs what is not stored yet.

    Args:
        replicates: What to run.
        folder: Where the results go, one file a replicate.
        jobs: Replicates that run at the same time.
        backend: Where they run.

    Raises:
        Exception: What a replicate raised, after all others have run and are stored.
    """
    todo = [replicate for replicate in replicates if not replicate.path(folder).exists()]
    calls = (delayed(_run_one)(replicate) for replicate in todo)
    failure: Exception | None = None
    with parallel(backend), tqdm(total=len(todo), desc=str(folder), unit="replicate") as bar:
        for replicate, result in Parallel(n_jobs=jobs, return_as="generator_unordered")(calls):
            if isinstance(result, Exception):
                failure = failure or result
            else:
                write_json(replicate.path(folder), result | provenance(sys.argv))
            bar.set_postfix_str(f"{replicate.method}-{replicate.seed}")
            bar.update()
    if failure is not None:
        raise failure


def load_results(folder: Path) -> list[Result]:
    """All stored results of a folder, by method and seed.

    Raises:
        FileNotFoundError: There are none.
    """
    results = [json.loads(path.read_text()) for path in sorted(folder.glob("*-*.json"))]
    if not results:
        raise FileNotFoundError(f"{folder} holds no results; run the benchmark first.")
    return sorted(results, key=lambda result: (result["method"], result["seed"]))


def provenance(argv: list[str]) -> Result:
    """What it takes to run something again: command, commit and versions."""
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False)
    return {
        "command": " ".join(["python", *_command(argv)]),
        "commit": commit.stdout.strip() or "unknown",
        "versions": {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES},
    }


def write_json(path: Path, value: Any) -> None:
    """Writes a file that is either whole or not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(value, indent=1) + "\n")
    partial.replace(path)


def _run_one(replicate: Replicate) -> tuple[Replicate, Result | Exception]:
    """The result of a replicate, or what it raised: one that fails must not end the others."""
    import torch

    torch.set_num_threads(1)  # replicates that run at the same time share the cores
    start = time.perf_counter()
    try:
        result = replicate.run()
    except Exception as error:
        error.add_note(f"Raised by {replicate.method}-{replicate.seed}.")
        return replicate, error
    named = {"method": replicate.method, "seed": replicate.seed, **result}
    return replicate, named | {"wall_seconds": time.perf_counter() - start}


def _command(argv: list[str]) -> list[str]:
    """The command line with a module instead of its file's path."""
    script = Path(argv[0])
    return (["-m", f"benchmarks.{script.stem}"] if script.parent.name == "benchmarks" else [script.name]) + argv[1:]
