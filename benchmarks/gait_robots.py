"""What the benchmarks of the quadruped and the Minitaur share: one replicate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.harness import Result
from benchmarks.methods import METHODS, Method, about
from benchmarks.task import Task
from famle_agent import FAMLEWrapper, ModelBasedAgent
from famle_agent.rollout import rollout

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
    walk = rollout(env, task.seed, task.later, None if task.later is None else task.strikes_at)
    profile = str(env.get_wrapper_attr("profile"))
    env.close()
    return {
        "situation": str(task.situation),
        "later": None if task.later is None else str(task.later),
        "profile": profile,
        **about(agent),
        "gaits": walk.steps,
        "reached": walk.success,
        "fell": walk.fell,
        "distance": round(float(walk.position[-1, 0]), 3),
        "believed": walk.situations[-1],
        "path": np.round(walk.position, 3).tolist(),
        "ms_per_plan": round(1e3 * float(np.median(walk.plan_seconds)), 1),
    }
