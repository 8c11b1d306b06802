"""What the benchmarks of the quadruped and the Minitaur share: one replicate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.methods import METHODS, Method, about, model_based
from benchmarks.results import Result
from benchmarks.task import Task
from famle_agent import FAMLEWrapper
from famle_agent.rollout import rollout

__all__ = ["run"]


def run(method: str, tasks: Sequence[Task], known: Mapping[str, Method] = METHODS) -> list[Result]:
    """Runs an episode of one test robot."""
    (task,) = tasks
    agent = model_based(known[method], task)
    env = FAMLEWrapper(task.make(), agent)
    walk = rollout(env, task.seed, task.later, None if task.later is None else task.strikes_at)
    profile = str(env.get_wrapper_attr("profile"))
    env.close()
    result: Result = {
        "situation": str(task.situation),
        "later": None if task.later is None else str(task.later),
        "profile": profile,
        "gaits": walk.steps,
        "reached": walk.success,
        "fell": walk.fell,
        "distance": round(float(walk.position[-1, 0]), 3),
        "believed": walk.situations[-1],
        "path": np.round(walk.position, 3).tolist(),
        "ms_per_plan": round(1e3 * float(np.median(walk.plan_seconds)), 1),
    }
    return [result | about(agent)]
