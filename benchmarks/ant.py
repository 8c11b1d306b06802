"""The ant: unseen damage, damage in the middle of a run, and what each part of FAMLE buys.

python -m benchmarks.ant                              # a dead joint and a yaw error together, new for each replicate
python -m benchmarks.ant --experiment break           # the same, striking in the middle of a run
python -m benchmarks.ant --experiment untrained       # kinds of damage that were not trained at all
python -m benchmarks.ant --experiment intact --methods famle random-shooting --replicates 3
python -m benchmarks.ant --experiment members         # ensembles of one to four
python -m benchmarks.ant --experiment curves --replicates 10   # all methods over many episodes: the paper's figure 4

Replicates share the shipped model; each has its own damage and its own seed of the robot and the planner. The agent
without embeddings is trained from scratch by its method, and the one that is told its damage learns on from the
shipped model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from benchmarks import curves
from benchmarks.ant_informed import informed
from benchmarks.methods import METHODS, PPO_METHODS, Method, about, famle, from_cache, model_based, on_its_way
from benchmarks.results import Result
from benchmarks.runner import Options, launch, run_experiment
from benchmarks.task import Task
from famle_agent import FAMLE, FAMLEWrapper
from famle_agent.agents.presets import known_robots
from famle_agent.agents.world_model import WorldModel
from famle_agent.models.members import with_members as some_of
from famle_agent.rollout import Rollout, rollout
from famle_envs import Situation
from famle_envs.ant import AntEnv
from famle_envs.wrappers import RandomSituation

WALKS = 0.8  # m/s
BIN = 50  # steps of a stored mean speed
VARIANTS: dict[str, dict[str, Any]] = {
    "famle": {},
    "famle-48": {"candidates": 48},
    "famle-frozen": {"adapt_every": 0},
    "famle-select": {"adapt_steps": 0},
    "famle-nearest": {"adapt_steps": 0, "compose": False},
    "famle-window": {"hazard": 0.0, "likelihood_power": 1.0, "selection_size": 100},
    "famle-h": {"adapt_lr": 0.0},
    "famle-validated": {"validation_size": 10},
    "random-shooting": {"planner": "random_shooting", "candidates": 10_000},
}
"""The shipped agent with settings changed."""


@dataclass(frozen=True)
class Args(Options):
    """The ant: unseen damage, damage in the middle of a run, and the paper's figure 4."""

    experiment: Literal["unseen", "break", "untrained", "intact", "members", "validation", "curves"] = "unseen"
    """What happens to the robot; "curves" are episodes one after the other, the others are one episode."""
    replicates: int = 20
    """Damages, seeded 0, 1, ..."""
    steps: int = 1000
    """Robot steps of a replicate, all in one episode."""
    curve_steps: int = 25_000
    """Robot steps of the model-based methods in "curves"."""
    ppo_steps: int = 1_000_000
    """Robot steps of PPO in "curves"."""
    in_step: int = 5
    """Replicates of one method that act in step at most in "curves", where its robots can do that."""


def damage_of(experiment: str, seed: int) -> Situation:
    """Makes the situation of a replicate; only those of "validation" and "members" were looked at while tuning."""
    if experiment == "intact":
        return Situation()
    if experiment == "untrained":
        return untrained(seed)
    return AntEnv.sample_situation(
        np.random.default_rng([7 if experiment in ("validation", "members") else 2020, seed])
    )


def untrained(seed: int) -> Situation:
    """Draws damage that was not trained: two weak joints, a reversed one, a locked one, another floor."""
    rng = np.random.default_rng([2022, seed])
    gain = np.ones(len(AntEnv.joints))
    one, two = rng.choice(len(gain), size=2, replace=False)
    kind = seed % 4
    if kind == 0:
        gain[[one, two]] = rng.uniform(0.1, 0.6, 2)
    elif kind == 1:
        gain[one] = rng.uniform(-1.0, -0.5)
    elif kind == 2:
        return Situation(locked_joints=(int(one),))
    else:
        return Situation(friction=float(rng.choice([0.25, 0.5, 2.0])))
    return Situation(motor_gain=tuple(gain))


def with_members(task: Task, members: int) -> FAMLE:
    """Makes the shipped agent with fewer members."""
    agent = famle(task)
    agent.policy.world = WorldModel(some_of(agent.model, members), agent.situations)
    return agent


def without_embeddings(task: Task) -> FAMLE:
    """Learns one model of all situations, as FAMLE after two rounds; it can only follow by gradient steps on theta."""
    simulation, n = known_robots()["ant"].config("ours").simulation, len(AntEnv.training_situations)
    budget: dict[str, Any] = {
        "rounds": 2,
        "transitions_per_situation": n * simulation.transitions(0),
        "round_transitions": n * simulation.transitions(1),
    }
    agent = FAMLE(task.simulated(), seed=0, device="cpu", pretrained=False, compose=False, **budget)
    path = task.cache / "ant-without-embeddings.zip"
    mixed = [lambda: RandomSituation(task.simulated())]
    return from_cache(agent, path, lambda agent: agent.meta_learn(mixed, folder=on_its_way(path)))


def _in_step(tasks: Sequence[Task], **overrides: Any) -> FAMLE:
    """Makes the shipped agent, which can act on many robots."""
    return famle(tasks[0], **overrides)


ANT_METHODS = {
    **{name: method for name, method in METHODS.items() if name != "oracle"},
    **{
        name: Method(partial(famle, **overrides), fleet=partial(_in_step, **overrides))
        for name, overrides in VARIANTS.items()
    },
    **{f"members-{n}": Method(partial(with_members, members=n)) for n in (1, 2, 3)},
    "without-embeddings": Method(without_embeddings, without_embeddings),
    "informed": Method(informed),
}
"""What every robot can be run with, and what was asked of the ant alone."""


def run(method: str, tasks: Sequence[Task], args: Args) -> list[Result]:
    """Runs one replicate, broken from the first step or after 300 steps; of curves one, or many in step."""
    if args.experiment == "curves":
        steps = args.ppo_steps if method in PPO_METHODS else args.curve_steps
        return curves.run(ANT_METHODS[method].on(tasks), tasks, steps, args.minutes)
    (task,) = tasks
    agent = model_based(ANT_METHODS[method], task)
    break_at = 300 if args.experiment == "break" else 0
    begins = task if break_at == 0 else replace(task, situation=Situation())
    env = FAMLEWrapper(begins.make(max_episode_steps=args.steps), agent)
    result = rollout(env, task.seed, task.situation, break_at)
    env.close()
    return [_result(result, task.situation) | about(agent)]


def _result(result: Rollout, situation: Situation) -> Result:
    """What is stored of a run; its return counts from the damage on."""
    bins = result.reward[: result.steps // BIN * BIN].reshape(-1, BIN).mean(axis=1)
    milliseconds = 1e3 * result.step_seconds
    return {
        "situation": str(situation),
        "believed": result.situations[-1],
        "return": round(float(result.reward[result.breaks_at :].sum()), 1),
        "recovery": result.recovery(WALKS),
        "speed": [round(float(value), 3) for value in bins],
        "break_at": result.breaks_at,
        "ms_per_step": {
            "mean": round(float(milliseconds.mean()), 2),
            "median": round(float(np.median(milliseconds)), 2),
            "p99": round(float(np.percentile(milliseconds, 99)), 2),
        },
    }


def main(args: Args) -> None:
    """Runs and reports."""
    tasks = [
        Task("ant", seed, damage_of(args.experiment, seed), args.cache, device=args.device)
        for seed in range(args.replicates)
    ]
    together = args.experiment == "curves"
    run_experiment(f"ant-{args.experiment}", tasks, partial(run, args=args), args, ANT_METHODS, together)


if __name__ == "__main__":
    launch(main, Args)
