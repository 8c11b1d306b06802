"""The paper's figure 2: a sine wave from three, four and five points, by FAMLE and by MAML.

python -m benchmarks.sine

Sines are y = A sin(x + phase) with A in [0.1, 5], phase in [0, pi] and x in [-5, 5] (Finn et al., 2017). To the
agent's parts a sine is a robot without actions, whose state x changes by y.

Both methods get the same training sines, the same network, the same number of gradient steps at the test, and with
the iterations below about the same wall time of meta-learning, which is stored. MAML is second-order, and its outer
gradient is shortened, without which it did far worse. The settings of the meta-learning were tuned by hand for each
method, on sines that are neither in the training sets nor in the test sets below. The rates of the steps at the test
are chosen in each replicate, by each method for itself, on validation sines of its own. No choice is made on a test
sine.

Each replicate has its own training, validation and test sines and its own initial networks.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.stats import trim_mean
from torch import Tensor

from benchmarks.reporting.statistics import interquartile_mean
from benchmarks.results import Result, provenance, store
from benchmarks.runner import launch
from famle_agent.adaptation.belief import prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.posterior import window_posterior
from famle_agent.adaptation.update import descend, select
from famle_agent.app.plots import style
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.simulator import Simulator
from famle_agent.training.maml import MAML
from famle_agent.training.reptile import Reptile

N_POINTS = (3, 4, 5)
HIDDEN = (40, 40)  # Finn et al.'s network
POINTS_PER_SINE = 50  # of a training sine
TEST_STEPS = 32  # k at the test, for both
GRID = torch.linspace(-5.0, 5.0, 200)

# At the test: plain gradient descent, its rates chosen among these on the validation sines.
FAMLE_RATES = tuple(InnerLoop(TEST_STEPS, lr, beta) for lr, beta in product((0.003, 0.01, 0.03), (0.3, 1.0)))
MAML_RATES = tuple(InnerLoop(TEST_STEPS, lr, embedding_lr=0.0) for lr in (0.01, 0.03, 0.05, 0.1, 0.15, 0.2))
SELECTION_ONLY = (InnerLoop(steps=0, lr=0.0, embedding_lr=0.0),)


@dataclass(frozen=True)
class Args:
    """Learns to learn sine waves and compares FAMLE with MAML."""

    replicates: int = 5
    """Replicates, seeded 0, 1, ..."""
    train_sines: int = 200
    """Sines to meta-learn from, N; FAMLE has an embedding of each."""
    validation_sines: int = 100
    """Sines on which each method chooses its rates."""
    test_sines: int = 200
    """Unseen sines per replicate."""
    famle_iterations: int = 1000
    """Iterations of Reptile, of ten inner steps each."""
    maml_iterations: int = 3000
    """Iterations of MAML, of two inner steps each; as many as fit the same time."""
    out: Path = Path("benchmarks/results")
    """Folder of sine.csv and sine.png."""

    def __post_init__(self) -> None:
        counts = {name: value for name, value in asdict(self).items() if name != "out"}
        if wrong := [name for name, value in counts.items() if value < 1]:
            raise ValueError(f"{', '.join(wrong)} must be at least 1.")
        if self.replicates * self.test_sines < 2:
            raise ValueError("The bootstrap needs at least two test sines: raise replicates or test_sines.")


@dataclass(frozen=True)
class Sines:
    """B sine waves.

    Attributes:
        amplitude: A, (B, 1).
        phase: In rad, (B, 1).
    """

    amplitude: Tensor
    phase: Tensor

    @classmethod
    def sample(cls, size: int, generator: torch.Generator) -> Sines:
        """Draws sines as Finn et al. do."""
        amplitude = 0.1 + 4.9 * torch.rand(size, 1, generator=generator)
        return cls(amplitude, math.pi * torch.rand(size, 1, generator=generator))

    def __call__(self, x: Tensor) -> Tensor:
        """Computes the sines' values y, (B, n), at x of (B, n) or (n,)."""
        return self.amplitude * torch.sin(x + self.phase)

    def observe(self, n: int, generator: torch.Generator) -> Memory:
        """Makes the transitions x -> x + y at n random places on each sine."""
        x = 10.0 * torch.rand(len(self.phase), n, generator=generator) - 5.0
        obs, next_obs = x[..., None], (x + self(x))[..., None]
        nothing = torch.zeros(*x.shape, 0)
        return Memory.full(obs, nothing, next_obs, log_p=nothing)


@dataclass(frozen=True)
class Learner:
    """A meta-trained model and how it adapts.

    Attributes:
        model: Holds theta_meta and H_meta.
        inner_loop: The steps at the test.
        seconds: Wall time of the meta-learning.
    """

    model: Dynamics
    inner_loop: InnerLoop
    seconds: float

    def fit(self, points: Memory) -> Tensor:
        """Runs lines 2 and 3 of Algorithm 2, and predicts y on GRID for each of B sines, (B, 200)."""
        sines, alone = len(points.weight), Candidates.of(self.model, compose=False)
        data = self.model.encode(points.obs, points.action, points.next_obs, points.weight)
        points = replace(points, log_p=alone.log_likelihood(self.model, data))
        belief = replace(prior(self.model, alone, sines), log_posterior=window_posterior(alone, points))
        belief = descend(self.model, select(self.model, alone, belief), points, self.inner_loop)
        x = GRID.expand(sines, -1)[..., None]
        predicted = Simulator(self.model, belief.h, belief.theta)(x, torch.zeros(sines, len(GRID), 0))[:, 0]
        return (predicted - x)[..., 0].detach()

    def errors(self, sines: Sines, points: Memory) -> Tensor:
        """Computes mean squared errors over GRID from 3, 4 and 5 points, (3, B); infinite where the steps diverged."""
        errors = [(self.fit(first(points, n)) - sines(GRID)).square().mean(dim=1) for n in N_POINTS]
        return torch.stack(errors).nan_to_num(nan=math.inf)


def first(points: Memory, n: int) -> Memory:
    """Takes the first n points of each sine."""
    return Memory(**{name: values[:, :n] for name, values in vars(points).items()})


def meta_learn(learn: Reptile | MAML, data: Memory, n_situations: int, inner_loop: InnerLoop, seed: int) -> Learner:
    """Meta-trains a fresh model of ``n_situations`` embeddings."""
    torch.manual_seed(seed)
    model = Dynamics(1, 0, n_situations, embedding_dim=4, hidden=HIDDEN, gate_actions=False)
    model.fit_normalisation(data.obs, data.action, data.next_obs)
    start = time.perf_counter()
    # The model's noise stays 1: of a single target, its size does not change which embedding is most likely.
    batch = model.encode(data.obs, data.action, data.next_obs)
    for _ in learn.steps(model, batch, inner_loop, torch.Generator().manual_seed(seed)):
        pass
    return Learner(model, inner_loop, time.perf_counter() - start)


def choose_rates(learner: Learner, rates: tuple[InnerLoop, ...], sines: Sines, points: Memory) -> Learner:
    """Takes the rates of the least interquartile mean error over all validation fits."""

    def error(candidate: Learner) -> float:
        return float(trim_mean(candidate.errors(sines, points).double().numpy().ravel(), 0.25))

    return min((Learner(learner.model, inner_loop, learner.seconds) for inner_loop in rates), key=error)


def learners(args: Args, seed: int, generator: torch.Generator) -> dict[str, Learner]:
    """Meta-trains both methods on the same sines, and lets them choose their rates."""
    data = Sines.sample(args.train_sines, generator).observe(POINTS_PER_SINE, generator)
    validation = Sines.sample(args.validation_sines, generator)
    points = validation.observe(max(N_POINTS), generator)

    reptile = Reptile(
        args.famle_iterations, meta_lr=1.0, embedding_meta_lr=1.0, meta_batch_size=25, batch_size=POINTS_PER_SINE // 2
    )
    steps = InnerLoop(steps=10, lr=0.005, embedding_lr=0.05, optimizer="adam")
    famle = meta_learn(reptile, data, args.train_sines, steps, seed)

    maml = MAML(args.maml_iterations, meta_lr=0.01, meta_batch_size=25, batch_size=max(N_POINTS), query_size=20)
    rival = meta_learn(maml, data, 1, InnerLoop(steps=2, lr=0.1, embedding_lr=0.0), seed)

    return {
        "FAMLE": choose_rates(famle, FAMLE_RATES, validation, points),
        "MAML": choose_rates(rival, MAML_RATES, validation, points),
        "selection only": choose_rates(famle, SELECTION_ONLY, validation, points),
    }


def picture(by_method: dict[str, Learner], sines: Sines, points: Memory, i: int, path: Path) -> None:
    """Draws the fits of sine ``i`` with three, four and five points."""
    figure = Figure(figsize=(9.6, 2.9), layout="constrained")
    panels = figure.subplots(1, len(N_POINTS), sharey=True)
    for axes, n in zip(panels, N_POINTS, strict=True):
        seen = first(points, n)
        axes.plot(GRID, sines(GRID)[i], color="0.6", linewidth=3, label="truth")
        for method, color, dashes in (("FAMLE", "C0", "-"), ("MAML", "C3", "--")):
            axes.plot(GRID, by_method[method].fit(seen)[i], color=color, linestyle=dashes, label=method)
        axes.plot(seen.obs[i], (seen.next_obs - seen.obs)[i], "ko", markersize=5, label="points", zorder=3)
        style(axes, "x", "y" if n == N_POINTS[0] else "", f"{n} points")
    panels[0].legend(fontsize="small")
    figure.savefig(path, dpi=120)


def replicate(args: Args, seed: int) -> tuple[dict[str, Learner], dict[str, NDArray[np.float64]]]:
    """Runs one seed: the learner of each method, and its errors, (3, test_sines)."""
    generator = torch.Generator().manual_seed(seed)
    by_method = learners(args, seed, generator)
    test = Sines.sample(args.test_sines, generator)
    points = test.observe(max(N_POINTS), generator)
    errors = {method: learner.errors(test, points).double().numpy() for method, learner in by_method.items()}
    if seed == 0:
        # The sine of the median ratio of the errors: neither method's showpiece.
        typical = int((errors["FAMLE"] / errors["MAML"])[1].argsort()[args.test_sines // 2])
        picture(by_method, test, points, typical, args.out / "sine.png")
    return by_method, errors


def summary(errors: NDArray[np.float64]) -> Result:
    """Computes statistics of the errors of one method with one number of points, (replicates, test_sines).

    The interval is over the test sines, with the meta-trained models as they are.
    """
    low, median, high = np.percentile(errors, [25, 50, 75])
    mean, *interval = interquartile_mean(errors.ravel())
    return {
        "median": float(median),
        "quartiles": [float(low), float(high)],
        "iqm": mean,
        "iqm_interval": interval,
        "iqm_per_replicate": [float(trim_mean(values, 0.25)) for values in errors],
    }


def main(args: Args) -> None:
    """Runs all replicates, stores a row for each method and number of points, and a picture of one test sine."""
    torch.set_num_threads(1)
    start = time.perf_counter()
    args.out.mkdir(parents=True, exist_ok=True)
    runs = [replicate(args, seed) for seed in range(args.replicates)]
    errors = {
        method: np.stack([of[method] for _, of in runs], axis=1) for method in runs[0][1]
    }  # (3, replicates, sines)
    better = (errors["FAMLE"] < errors["MAML"]).mean(axis=(1, 2))
    shared = {
        "title": f"Mean squared error over x, {args.replicates} replicates of {args.test_sines} unseen sines",
        "seeds": list(range(args.replicates)),
        "args": asdict(args) | {"out": str(args.out)},
        "wall_seconds": time.perf_counter() - start,
    } | provenance(sys.argv)
    rows = []
    for method in errors:
        used = [by_method[method] for by_method, _ in runs]
        rates, seconds = [asdict(learner.inner_loop) for learner in used], [learner.seconds for learner in used]
        about = {"rates": rates, "meta_learning_seconds": seconds, **shared}
        for i, n in enumerate(N_POINTS):
            row = {
                "method": method,
                "points": n,
                **summary(errors[method][i]),
                "famle_better_than_maml": float(better[i]),
            }
            rows.append(row | about)
    store(args.out / "sine.csv", rows, keys=("method", "points"))
    columns = ["points", "method", "median", "quartiles", "iqm", "iqm_interval"]
    print(
        shared["title"],
        pd.DataFrame(rows)[columns].sort_values("points", kind="stable").to_string(index=False),
        sep="\n",
    )


if __name__ == "__main__":
    launch(main, Args)
