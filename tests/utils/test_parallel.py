from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray

from benchmarks.results import load
from benchmarks.runner import Batch, ReplicateError, run_batches
from famle_agent import FAMLE
from famle_agent.utils.parallel import parallel

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A Ray cluster of two workers on this machine."""
    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}  # workers have to find this file
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, runtime_env={"env_vars": paths})
    yield
    ray.shutdown()


def drawn(seed: int) -> dict[str, Any]:
    if seed == 3:
        raise ArithmeticError("a replicate fails")
    return {"values": np.random.default_rng(seed).normal(size=3).tolist(), "process": os.getpid()}


def batches() -> list[Batch]:
    batches = [Batch("single", (seed,), partial(lambda seed: [drawn(seed)], seed)) for seed in range(5)]
    return [*batches, Batch("fleet", (0, 1), partial(lambda seeds: [drawn(seed) for seed in seeds], (0, 1)))]


def values(table: Path) -> dict[tuple[str, int], list[float]]:
    return {(result["method"], result["seed"]): result["values"] for _, result in load(table).iterrows()}


def test_two_workers_collect_what_one_process_does(cluster: None) -> None:
    one, two = (FAMLE("reacher", seed=0, device="cpu", transitions_per_situation=60) for _ in range(2))
    here = one.collect()
    with parallel("ray"):
        there = two.collect(n_jobs=2)
    assert here.digest() == there.digest()
    assert here.situations == there.situations


def test_two_workers_store_what_one_process_does_and_lose_nothing(cluster: None, tmp_path: Path) -> None:
    for backend, jobs in (("loky", 1), ("ray", 2)):
        with pytest.raises(ReplicateError, match="ArithmeticError: a replicate fails"):
            run_batches(batches(), tmp_path / f"{backend}.csv", jobs, backend)  # type: ignore[arg-type]
    assert values(tmp_path / "ray.csv") == values(tmp_path / "loky.csv")
    assert os.getpid() not in set(load(tmp_path / "ray.csv")["process"])
    assert set(values(tmp_path / "ray.csv")) == {("single", seed) for seed in (0, 1, 2, 4)} | {
        ("fleet", 0),
        ("fleet", 1),
    }


def test_cluster_of_somebody_else_is_left_running(cluster: None) -> None:
    with parallel("ray"):
        pass
    assert ray.is_initialized()


def test_old_name_goes_on_working_with_a_warning() -> None:
    with pytest.warns(DeprecationWarning, match=r"famle_agent\.utils\.parallel"):
        cluster = importlib.import_module("famle_agent.cluster")
    assert cluster.parallel is parallel
