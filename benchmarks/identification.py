"""What a model knows: which situation it is in, and what comes next, by the number of transitions that were seen.

python -m benchmarks.identification                  # the arm and the ant
python -m benchmarks.identification --robots ant

Named right: held-out windows of every training situation, whose own embedding is the likeliest. Prediction: errors on
later transitions of unseen damage, by what is done with the first ones.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pandas as pd
import torch
from torch import Tensor

from benchmarks import ant, reacher
from benchmarks.methods import famle
from benchmarks.results import Result, provenance, store
from benchmarks.runner import launch
from benchmarks.task import Task
from famle_agent import Transitions
from famle_agent.adaptation.belief import Belief, prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.posterior import window_posterior
from famle_agent.adaptation.update import descend, select
from famle_agent.agents.presets import known_robots
from famle_agent.data.collect import collect
from famle_agent.data.policies import make_held_uniform
from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.simulator import Simulator
from famle_envs import Situation

STEPS_AHEAD = 20  # of the long error
LATER = 300  # transitions after those that are seen

STEPS = known_robots()["ant"].config("ours").adaptation.gradient.inner_loop(0)  # type: ignore[union-attr]
"""The gradient steps of one adaptation by default."""

CANDIDATES = {"training situations": False, "sums too": True}
"""Whether sums of embeddings are candidates."""

ADAPTATIONS = {
    "nearest embedding": (False, 0),
    "sums of embeddings": (True, 0),
    "and steps on theta and h": (True, STEPS.steps),
}
"""Whether sums of embeddings are candidates, and the number of gradient steps."""


@dataclass(frozen=True)
class Args:
    """Asks models about data that they have not seen."""

    robots: tuple[Literal["reacher", "ant"], ...] = ("reacher", "ant")
    """Robots; each replicate of the arm has a model of its own, the ant's is the shipped one."""
    replicates: int = 3
    """Held-out data sets of the training situations."""
    damages: int = 10
    """Unseen damages on which errors are measured."""
    windows: int = 10
    """Windows of the largest size per situation and kind of data."""
    sizes: tuple[int, ...] = (5, 10, 25, 100)
    """Transitions in a window."""
    seen: tuple[int, ...] = (0, 1, 2, 5, 10, 25, 50, 100)
    """Transitions before an error is measured."""
    jobs: int = 2
    """Parallel processes that simulate."""
    cache: Path = Path("runs/agents")
    """Folder of the agents that are learnt in simulation."""
    out: Path = Path("benchmarks/results")
    """Folder of identification.csv and prediction.csv."""


def main(args: Args) -> None:
    """Measures, stores and prints."""
    torch.set_num_threads(1)
    for robot in args.robots:
        start = time.perf_counter()
        named = [row for seed in range(args.replicates) for row in identification(robot, seed, args)]
        errors = [row for seed in range(args.damages) for row in prediction(robot, seed, args)]
        about = {"robot": robot, "wall_seconds": time.perf_counter() - start} | provenance(sys.argv)
        store(args.out / "identification.csv", [row | about for row in named], keys=("robot",))
        store(args.out / "prediction.csv", [row | about for row in errors], keys=("robot",))
        print(
            f"\n{robot}: named right",
            pd.DataFrame(named).pivot_table("accuracy", ["data", "candidates"], "transitions"),
        )
        medians = pd.DataFrame(errors).pivot_table(
            ["error_1_step", "error_20_steps"], "adaptation", "transitions", aggfunc="median"
        )
        print(f"\n{robot}: median error", medians.round(3).to_string())


def identification(robot: str, seed: int, args: Args) -> Iterator[Result]:
    """Measures how often windows of held-out transitions are named right."""
    agent = famle(Task(robot, seed, Situation(), args.cache))
    envs, n = agent.situation_envs(), args.windows * max(args.sizes)
    for planned, kind in enumerate(("random actions", "planned actions")):
        make_policy = agent.planning_policy() if planned else make_held_uniform(agent.config.simulation.action_hold)
        data_seed = 10_000 + 2 * seed + planned
        data = collect(envs.sources, envs.situations, n, make_policy, data_seed, n_jobs=args.jobs)
        for name, compose in CANDIDATES.items():
            candidates = Candidates.of(agent.model, compose)
            log_p = log_likelihood(agent.model, candidates, data)
            for size in args.sizes:
                right = accuracy(log_p, candidates, size)
                yield {"seed": seed, "data": kind, "candidates": name, "transitions": size, "accuracy": right}


@torch.no_grad()
def prediction(robot: str, seed: int, args: Args) -> Iterator[Result]:
    """Measures errors on later transitions, by the number of first ones that were seen and what is done with them."""
    situation = ant.damage_of("unseen", seed) if robot == "ant" else reacher.situation_of("random", seed)
    task = Task(robot, seed, situation, args.cache)
    agent, first = famle(task), max(args.seen)
    random_actions = make_held_uniform(agent.config.simulation.action_hold)
    data = collect([task.make], [situation.label], first + LATER, random_actions, 20_000 + seed)
    for name, (compose, steps) in ADAPTATIONS.items():
        for n in args.seen:
            belief = adapted(agent.model, Candidates.of(agent.model, compose), data, n, steps)
            one, many = prediction_errors(agent.model, belief, data, first)
            errors = {"error_1_step": one, "error_20_steps": many}
            yield {"seed": seed, "situation": str(situation), "adaptation": name, "transitions": n} | errors


def log_likelihood(model: Dynamics, candidates: Candidates, data: Transitions) -> Tensor:
    """Computes log p of each transition under each candidate, (N, n, C)."""
    batch = model.encode(*(torch.as_tensor(values) for values in (data.obs, data.action, data.next_obs)))
    # One situation at a time: all under all candidates at once would be some 10^7 rows.
    parts = [Batch(batch.x[[i]], batch.y[[i]], batch.weight[[i]]) for i in range(len(batch.x))]
    return torch.cat([candidates.log_likelihood(model, part) for part in parts])


def accuracy(log_p: Tensor, candidates: Candidates, size: int) -> float:
    """Computes the fraction of windows of ``size`` whose own situation is the likeliest; log_p is (N, n, C)."""
    situations, n, n_candidates = log_p.shape
    windows = log_p[:, : n // size * size].view(situations, -1, size, n_candidates).sum(dim=2)
    named = (windows + candidates.log_prior).argmax(dim=2)
    return float((named == torch.arange(situations)[:, None]).float().mean())


def adapted(model: Dynamics, candidates: Candidates, data: Transitions, n: int, steps: int) -> Belief:
    """Adapts to the first n transitions of one robot, as the ant does with gradient steps."""
    belief = prior(model, candidates, 1)
    if n == 0:
        return belief
    obs, action, next_obs = (torch.as_tensor(values[:, :n]) for values in (data.obs, data.action, data.next_obs))
    log_p = candidates.log_likelihood(model, model.encode(obs, action, next_obs))
    memory = Memory.full(obs, action, next_obs, log_p)
    belief = replace(belief, log_posterior=window_posterior(candidates, memory))
    inner_loop = replace(STEPS, steps=steps)
    return descend(model, select(model, candidates, belief), memory, inner_loop)


def prediction_errors(model: Dynamics, belief: Belief, data: Transitions, first: int) -> tuple[float, float]:
    """Computes errors from step ``first`` on, 1 and 20 steps ahead.

    They are root mean squares, in deviations of the observation.
    """
    obs, action, next_obs = (torch.as_tensor(v[0, first:]) for v in (data.obs, data.action, data.next_obs))
    simulator, scale = Simulator(model, belief.h, belief.theta), obs.std(dim=0).clamp(min=1e-3)
    starts = torch.arange(0, len(obs) - STEPS_AHEAD, 5)
    state = obs[starts][None]  # (1, n, obs_dim), and (1, P, n, obs_dim) once the members disagree
    for t in range(STEPS_AHEAD):
        state = simulator(state, action[starts + t][None])
    one = simulator(obs[None], action[None])

    def distance(predicted: Tensor, true: Tensor) -> float:
        near = _nearer_quaternion(predicted[0].mean(dim=0), true, model)
        return float(((near - true) / scale).square().mean().sqrt())

    return distance(one, next_obs), distance(state, next_obs[starts + STEPS_AHEAD - 1])


def _nearer_quaternion(predicted: Tensor, true: Tensor, model: Dynamics) -> Tensor:
    """Takes the nearer one of q and -q, which are the same orientation."""
    predicted, q = predicted.clone(), model.layout.quaternion_dims
    sign = torch.where((predicted[..., q] * true[..., q]).sum(dim=-1, keepdim=True) < 0.0, -1.0, 1.0)
    predicted[..., q] *= sign
    return predicted


if __name__ == "__main__":
    launch(main, Args)
