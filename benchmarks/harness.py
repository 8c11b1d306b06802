"""Replicates: run in parallel, each stored as soon as it ends and skipped the next time."""

from __future__ import annotations

import json
import math
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from joblib import delayed
from tqdm import tqdm

from famle_agent.utils.atomic_write import whole_file
from famle_agent.utils.parallel import Backend, as_completed, parallel

__all__ = [
    "Fleet",
    "Options",
    "Replicate",
    "ReplicateError",
    "Result",
    "commit",
    "is_stored",
    "load_results",
    "provenance",
    "run_replicates",
    "write_json",
    "write_whole",
]

Result = dict[str, Any]
_PACKAGES = ("famle", "gymnasium", "matplotlib", "numpy", "pybullet", "scipy", "stable-baselines3", "torch")


class ReplicateError(RuntimeError):
    """A replicate failed."""


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
    lives: Path = Path("runs/lives")
    """Folder of long replicates on their way, which go on from there."""
    in_step: int = 30
    """Replicates of one method that act in step at most, where its robots can do that."""
    device: str = "cpu"
    """Where agents compute; their networks are learnt on the CPU."""
    minutes: float = math.inf
    """Wall time after which learning curves end with their episode; the report's title says how long they are."""

    def life(self, experiment: str, method: str, seeds: Sequence[int]) -> Path:
        """The file of the life of robots in step."""
        return self.lives / experiment / f"{method}-{seeds[0]}-of-{len(seeds)}.zip"


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

    @property
    def seeds(self) -> tuple[int, ...]:
        """As of a :class:`Fleet`."""
        return (self.seed,)

    def results(self) -> list[Result]:
        """As of a :class:`Fleet`."""
        return [self.run()]


@dataclass(frozen=True)
class Fleet:
    """Seeds of one method whose robots act in step, so that their networks cost one batched product.

    Attributes:
        method: What is run.
        seeds: Seeds of the replicates.
        results: Makes the result of each; picklable.
    """

    method: str
    seeds: tuple[int, ...]
    results: Callable[[], list[Result]]


def run_replicates(replicates: Iterable[Replicate | Fleet], folder: Path, jobs: int, backend: Backend = "loky") -> None:
    """Runs what is not stored yet; of a fleet, all replicates where one is missing.

    Args:
        replicates: What to run.
        folder: Where the results go, one file a replicate.
        jobs: Replicates that run at the same time.
        backend: Where they run.

    Raises:
        ReplicateError: A replicate failed; all others have run and are stored.
    """
    todo = [some for some in replicates if not is_stored(some, folder)]
    if not todo:
        return
    calls = (delayed(_run)(some) for some in todo)
    failure = ""
    with (
        parallel(backend),
        tqdm(total=sum(len(some.seeds) for some in todo), desc=str(folder), unit="replicate") as bar,
    ):
        origin = provenance(sys.argv)  # of the code that runs, whatever is committed meanwhile
        for some, results in as_completed(calls, jobs):
            if isinstance(results, str):
                failure = failure or results
            else:
                for seed, result in zip(some.seeds, results, strict=True):
                    write_json(_path(folder, some.method, seed), result | origin)
            bar.set_postfix_str(f"{some.method}-{some.seeds[-1]}")
            bar.update(len(some.seeds))
    if failure:
        raise ReplicateError(f"A replicate failed; the others are stored.\n{failure}")


def is_stored(some: Replicate | Fleet, folder: Path) -> bool:
    """Whether there is a result of every seed."""
    return all(_path(folder, some.method, seed).exists() for seed in some.seeds)


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
    return {
        "command": " ".join(_command(argv)),
        "commit": commit(),
        "versions": {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES},
    }


def commit() -> str:
    """What git calls this code, "-dirty" where it was changed since; "unknown" without git."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parent,
    )
    return described.stdout.strip() or "unknown"


def write_json(path: Path, value: Any) -> None:
    """Writes a value as JSON, as :func:`write_whole`."""
    write_whole(path, (json.dumps(value, indent=1) + "\n").encode())


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file that is either whole or not there; an older one stays until the new one is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial:
        partial.write_bytes(content)


def _path(folder: Path, method: str, seed: int) -> Path:
    return folder / f"{method}-{seed}.json"


def _run(some: Replicate | Fleet) -> tuple[Replicate | Fleet, list[Result] | str]:
    """The results, or the traceback of what was raised instead: one that fails must not end the others."""
    import torch

    torch.set_num_threads(1)  # replicates that run at the same time share the cores
    start = time.perf_counter()
    try:
        results = dict(zip(some.seeds, some.results(), strict=True))
    except Exception:
        return some, f"{some.method}, seed {some.seeds[0]}: {traceback.format_exc()}"
    shared = {"wall_seconds": time.perf_counter() - start} | ({} if len(results) == 1 else {"fleet": len(results)})
    return some, [{"method": some.method, "seed": seed, **shared, **result} for seed, result in results.items()]


def _command(argv: list[str]) -> list[str]:
    """The command line as a user types it, without the paths of a machine: of the file that it runs, and of results."""
    script, arguments = Path(argv[0]), _without_out(argv[1:])
    if script.parent.name == "benchmarks":
        return ["python", "-m", f"benchmarks.{script.stem}", *arguments]
    return [script.name, *arguments] if script.suffix != ".py" else ["python", script.name, *arguments]


def _without_out(arguments: list[str]) -> list[str]:
    """The arguments without where the results go, which changes nothing of them."""
    paths = {i + 1 for i, argument in enumerate(arguments) if argument == "--out"}
    return [a for i, a in enumerate(arguments) if a.split("=")[0] != "--out" and i not in paths]
