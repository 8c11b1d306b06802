"""What the benchmarks of the quadruped and the Minitaur share: one replicate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.harness import Result
from benchmarks.methods import METHODS, Method, about
from benchmarks.task import Task
from famle_agent import FAMLEWrapper, ModelBasedAgent
from famle_agent.journey import run_journey

__all__ = ["run"]


def run(method: str, task: Task, known: Mapping[str, Method] = METHODS) -> Result:
    """One replicate: an episode of the test robot."""
    agent = known[method].agent(task)
    if not isinstance(agent, ModelBasedAgent):
        raise ValueError(
            f"{method} needs more steps than an episode of the {task.robot} has; take a model-based method."
        )
    agent.set_random_seed(task.seed)
    env = FAMLEWrapper(task.make(), agent)
    journey = run_journey(env, task.seed, task.later, task.strikes_at)
    profile = str(env.get_wrapper_attr("profile"))
    env.close()
    return {
        "situation": str(task.situation),
        "later": None if task.later is None else str(task.later),
        "profile": profile,
        **about(agent),
        "gaits": journey.gaits,
        "reached": journey.reached,
        "fell": journey.fell,
        "distance": round(float(journey.path[-1, 0]), 3),
        "believed": journey.believed[-1],
        "path": np.round(journey.path, 3).tolist(),
        "ms_per_plan": round(1e3 * float(np.median(journey.seconds)), 1),
    }
