"""Does the agent know its situation? Held-out transitions of every training situation, named by likelihood.

python -m benchmarks.identification
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console

from benchmarks import command
from benchmarks.harness import provenance, write_json
from famle_agent import FAMLE, Transitions
from famle_agent.adaptation.belief import Candidates
from famle_agent.models.dynamics import Dynamics

_BASE, _TIP = 0, slice(10, 12)  # of the reacher's observation


@dataclass(frozen=True)
class Args:
    """Meta-trains agents and asks them to name held-out data."""

    replicates: int = 3
    """Agents, each with its own data, meta-training and test data."""
    windows: int = 20
    """Windows of held-out data per situation."""
    sizes: tuple[int, ...] = (5, 10, 25, 50)
    """Transitions in a window."""
    out: Path = Path("benchmarks/results/identification.json")
    """Where the result goes."""


def across_the_wrap(data: Transitions, i: int) -> Transitions:
    """Turns transition i of every situation about the base, so that the base angle jumps from pi to -pi or back.

    The base joint turns without end and nothing around it is special: the turned transition is as true as the other.
    """
    obs, next_obs = data.obs.copy(), data.next_obs.copy()
    angle = math.pi - 0.5 * (data.obs[:, i, _BASE] + data.next_obs[:, i, _BASE])
    cos, sin = np.cos(angle), np.sin(angle)
    for values in (obs, next_obs):
        values[:, i, _BASE] = (values[:, i, _BASE] + angle + math.pi) % (2 * math.pi) - math.pi
        x, y = values[:, i, _TIP].T
        values[:, i, _TIP] = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    return replace(data, obs=obs, next_obs=next_obs)


def accuracy(model: Dynamics, data: Transitions, size: int, windows: int, wrap: bool) -> float:
    """The fraction of windows of ``size`` transitions whose situation has the largest likelihood."""
    right = 0
    for window in range(windows):
        start = window * size
        part = replace(
            data,
            obs=data.obs[:, start : start + size],
            action=data.action[:, start : start + size],
            reward=data.reward[:, start : start + size],
            next_obs=data.next_obs[:, start : start + size],
        )
        if wrap:
            part = across_the_wrap(part, size // 2)
        batch = model.encode(*(torch.as_tensor(values) for values in (part.obs, part.action, part.next_obs)))
        named = Candidates.of(model, compose=False).log_likelihood(model, batch).sum(dim=1).argmax(dim=1)
        right += int((named == torch.arange(len(part.situations))).sum())
    return right / (windows * len(data.situations))


def main(args: Args) -> None:
    """Measures, prints and stores."""
    torch.set_num_threads(1)
    start, rows = time.perf_counter(), []
    for seed in range(args.replicates):
        agent = FAMLE("reacher", seed=seed, device="cpu").meta_learn()
        n = args.windows * max(args.sizes)
        held_out = FAMLE("reacher", seed=10_000 + seed, transitions_per_situation=n, action_hold=1).collect()
        model = agent.dynamics
        if model is None:
            raise RuntimeError("Meta-learning left no model.")
        for wrap in (False, True):
            rows.append(
                {"seed": seed, "one_crosses_the_wrap": wrap}
                | {str(size): accuracy(model, held_out, size, args.windows, wrap) for size in args.sizes}
            )
            Console().print(rows[-1])
    result = {"accuracy": rows, "windows": args.windows, "wall_seconds": time.perf_counter() - start}
    write_json(args.out, result | provenance(sys.argv))


if __name__ == "__main__":
    command.run(main, Args)
