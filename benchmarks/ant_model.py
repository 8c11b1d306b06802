"""What the ant's model knows: which situation it is in, and what will happen, by the number of transitions seen.

python -m benchmarks.ant_model
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks import command
from benchmarks.ant import ADAPTS, damage_of
from benchmarks.harness import provenance, write_json
from benchmarks.methods import shipped
from famle_agent import FAMLE, Transitions
from famle_agent.adaptation.adapters import descend, select
from famle_agent.adaptation.belief import Belief, Candidates, prior, window_posterior
from famle_agent.adaptation.memory import Memory
from famle_agent.data.collect import collect
from famle_agent.data.policies import make_held_uniform
from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.simulator import Simulator
from famle_envs import Situation

ROLLOUT = 20  # steps of the long error


@dataclass(frozen=True)
class Args:
    """Asks the shipped model about data that it has not seen."""

    windows: int = 10
    """Windows of the largest size per situation and kind of data."""
    sizes: tuple[int, ...] = (5, 10, 25, 100)
    """Transitions in a window."""
    damages: int = 10
    """Unseen damages on which errors are measured."""
    seen: tuple[int, ...] = (0, 1, 2, 5, 10, 25, 50, 100)
    """Transitions before an error is measured."""
    jobs: int = 2
    """Parallel processes that simulate."""
    out: Path = Path("benchmarks/results/ant-model.json")
    """Where the result goes."""


def simulate(agent: FAMLE, situations: Sequence[Situation], n: int, walking: bool, seed: int, jobs: int) -> Transitions:
    """Held-out transitions: random actions, or the agent's own planning, which knows the situation."""
    make_policy = agent.planning_policy() if walking else make_held_uniform(agent.hyperparameters.action_hold)
    envs = [_Factory(situation) for situation in situations]
    return collect(envs, [str(situation) for situation in situations], n, make_policy, seed, n_jobs=jobs)


@dataclass(frozen=True)
class _Factory:
    situation: Situation

    def __call__(self) -> Any:
        import gymnasium as gym

        import famle_envs  # noqa: F401 (registers the robots)

        return gym.make("FamleAnt-v0", situation=self.situation)


def accuracy(log_p: Tensor, candidates: Candidates, size: int) -> float:
    """The fraction of windows of ``size`` whose own situation is the most likely candidate; log_p is (N, n, C)."""
    situations, n, size_c = log_p.shape
    windows = log_p[:, : n // size * size].view(situations, -1, size, size_c).sum(dim=2)
    named = (windows + candidates.log_prior).argmax(dim=2)
    return float((named == torch.arange(situations)[:, None]).float().mean())


def identification(agent: FAMLE, data: Transitions, sizes: Sequence[int]) -> dict[str, dict[str, float]]:
    """Accuracy by window size, among the training situations and among their sums too."""
    model = agent.model
    batch = model.encode(*(torch.as_tensor(values) for values in (data.obs, data.action, data.next_obs)))
    result = {}
    for name, compose in (("training situations", False), ("sums too", True)):
        candidates = Candidates.of(model, compose)
        # One situation at a time: all under all candidates at once would be some 10^7 rows.
        parts = [Batch(batch.x[[i]], batch.y[[i]], batch.weight[[i]]) for i in range(len(batch.x))]
        log_p = torch.cat([candidates.log_likelihood(model, part) for part in parts])
        result[name] = {str(size): accuracy(log_p, candidates, size) for size in sizes}
    return result


def errors(model: Dynamics, belief: Belief, data: Transitions, first: int) -> dict[str, float]:
    """Errors from step ``first`` on, as root mean squares in deviations of the observation: 1 and 20 steps ahead."""
    obs, action, next_obs = (torch.as_tensor(v[0, first:]) for v in (data.obs, data.action, data.next_obs))
    simulator, scale = Simulator(model, belief.h, belief.theta), obs.std(dim=0).clamp(min=1e-3)
    starts = torch.arange(0, len(obs) - ROLLOUT, 5)
    state = obs[None, starts]
    for t in range(ROLLOUT):
        state = simulator(state, action[None, starts + t])  # (1, P, n, obs_dim)
    one = simulator(obs[None], action[None]).mean(dim=1)[0]

    def distance(predicted: Tensor, true: Tensor) -> float:
        return float(((_towards(predicted, true, model) - true) / scale).square().mean().sqrt())

    return {
        "1 step": distance(one, next_obs),
        f"{ROLLOUT} steps": distance(state.mean(dim=1)[0], next_obs[starts + ROLLOUT - 1]),
    }


def _towards(predicted: Tensor, true: Tensor, model: Dynamics) -> Tensor:
    """Of q and -q, the same orientation, the nearer one."""
    predicted = predicted.clone()
    q = model.layout.quaternion_dims
    sign = torch.where((predicted[..., q] * true[..., q]).sum(dim=-1, keepdim=True) < 0.0, -1.0, 1.0)
    predicted[..., q] *= sign
    return predicted


@torch.no_grad()
def learning_curve(agent: FAMLE, data: Transitions, seen: Sequence[int]) -> list[dict[str, Any]]:
    """Errors on later transitions by the number of first ones that were seen and by what is done with them."""
    model, rows = agent.model, []
    ways = {
        "nearest embedding": (False, 0),
        "sums of embeddings": (True, 0),
        "and steps on theta and h": (True, ADAPTS["adapt_steps"]),
    }
    for way, (compose, steps) in ways.items():
        candidates = Candidates.of(model, compose)
        inner_loop = InnerLoop(steps, ADAPTS["adapt_lr"], ADAPTS["adapt_embedding_lr"], "adam")
        for n in seen:
            belief = prior(model, candidates, 1)
            if n:
                obs, action, next_obs = (torch.as_tensor(v[:, :n]) for v in (data.obs, data.action, data.next_obs))
                log_p = candidates.log_likelihood(model, model.encode(obs, action, next_obs))
                memory = Memory.full(obs, action, next_obs, log_p)
                belief = replace(belief, log_posterior=window_posterior(candidates, memory))
                belief = descend(model, select(model, candidates, belief), memory, inner_loop)
            rows.append({"way": way, "seen": n, **errors(model, belief, data, max(seen))})
    return rows


def main(args: Args) -> None:
    """Measures, prints and stores."""
    torch.set_num_threads(1)
    start, agent = time.perf_counter(), shipped("ant", seed=0)
    training = list(agent.get_env().get_attr("training_situations")[0])  # type: ignore[union-attr]
    n = args.windows * max(args.sizes)
    named = {}
    for kind, walking in (("random actions", False), ("own walking", True)):
        data = simulate(agent, training, n, walking, 10_000 + walking, args.jobs)
        named[kind] = identification(agent, data, args.sizes)
    table = Table("data", "candidates", *(f"{size} transitions" for size in args.sizes), title="Situation named right")
    for kind, ways in named.items():
        for way, values in ways.items():
            table.add_row(kind, way, *(f"{value:.1%}" for value in values.values()))
    Console().print(table)

    rows = []
    for seed in range(args.damages):
        situation = damage_of("unseen", seed)
        data = simulate(agent, [situation], 400, False, 20_000 + seed, 1)
        rows += [{"situation": str(situation), **row} for row in learning_curve(agent, data, args.seen)]
    table = Table("after", *(str(n) for n in args.seen), title=f"Median error over {args.damages} unseen damages")
    for way in dict.fromkeys(row["way"] for row in rows):
        for error in ("1 step", f"{ROLLOUT} steps"):
            medians = [np.median([r[error] for r in rows if r["way"] == way and r["seen"] == n]) for n in args.seen]
            table.add_row(f"{way}, {error}", *(f"{value:.3f}" for value in medians))
    Console().print(table)
    result = {"identification": named, "errors": rows, "wall_seconds": time.perf_counter() - start}
    write_json(args.out, result | provenance(sys.argv))


if __name__ == "__main__":
    command.run(main, Args)
