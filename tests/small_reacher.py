"""The reacher's benchmark within a second: short episodes, small networks, and hardly any simulated data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.task import Task
from famle_envs import Situation
from famle_envs.reacher import ReacherEnv

EPISODE = 6
REDUCED: dict[str, Any] = {
    "transitions_per_situation": 12,
    "hidden": [8],
    "meta_iterations": 2,
    "inner_steps": 2,
    "batch_size": 4,
    "query_size": 4,
    "adapt_steps": 2,
    "memory_size": 20,
    "planner": "random_shooting",
    "horizon": 2,
    "candidates": 6,
}
SMALL_ROLLOUTS: dict[str, Any] = {"n_steps": 8, "batch_size": 8}


def task_of(seed: int, cache: Path, situation: Situation = ReacherEnv.presets["paper"]) -> Task:
    return Task("reacher", seed, situation, cache)
