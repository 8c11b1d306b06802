"""Replicates: run in parallel processes, each stored as soon as it ends and skipped the next time."""

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

__all__ = ["Replicate", "Result", "check_methods", "load_results", "provenance", "run_replicates", "write_json"]

Result = dict[str, Any]
_PACKAGES = ("famle", "gymnasium", "matplotlib", "numpy", "pybullet", "scipy", "stable-baselines3", "torch")


@dataclass(frozen=True)
class Replicate:
    """One seed of one method.

    Attributes:
        method: What is run.
        seed: Seed of its data, its meta-training and its robot.
        run: Makes the result; picklable, and alone responsible for its seeds.
    """

    method: str
    seed: int
    run: Callable[[], Result]

    def path(self, folder: Path) -> Path:
        """Where the result is stored."""
        return folder / f"{self.method}-{self.seed}.json"


def run_replicates(replicates: Iterable[Replicate], folder: Path, jobs: int) -> None:
    """Runs what is not stored yet.

    Args:
        replicates: What to run.
        folder: Where the results go, one file a replicate.
        jobs: Parallel processes.
    """
    folder.mkdir(parents=True, exist_ok=True)
    todo = [replicate for replicate in replicates if not replicate.path(folder).exists()]
    calls = (delayed(_run_one)(replicate, folder, sys.argv) for replicate in todo)
    done = Parallel(n_jobs=jobs, return_as="generator_unordered")(calls)
    for name in (bar := tqdm(done, total=len(todo), desc=str(folder), unit="replicate")):
        bar.set_postfix_str(name)


def check_methods(methods: Iterable[str], known: Iterable[str]) -> None:
    """Refuses methods that are not known, before anything runs.

    Raises:
        ValueError: There is one.
    """
    for method in methods:
        if method not in known:
            raise ValueError(f"There is no method {method!r}. Methods: {', '.join(known)}.")


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


def _run_one(replicate: Replicate, folder: Path, argv: list[str]) -> str:
    import torch

    torch.set_num_threads(1)  # the parallel processes share the cores
    start = time.perf_counter()
    result = replicate.run()
    named = {"method": replicate.method, "seed": replicate.seed, **result}
    write_json(replicate.path(folder), named | {"wall_seconds": time.perf_counter() - start} | provenance(argv))
    return f"{replicate.method}-{replicate.seed}"


def _command(argv: list[str]) -> list[str]:
    """The command line with a module instead of its file's path."""
    script = Path(argv[0])
    return (["-m", f"benchmarks.{script.stem}"] if script.parent.name == "benchmarks" else [script.name]) + argv[1:]
