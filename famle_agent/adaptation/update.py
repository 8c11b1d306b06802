"""Lines 2 and 3 of Algorithm 2: select the most likely embedding, then take k gradient steps on theta and h."""

from __future__ import annotations

from dataclasses import replace

import torch

from famle_agent.adaptation.belief import Belief, choose
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory, Sample, minibatches, whole_memory
from famle_agent.adaptation.settings import Adaptation
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.utils.deadline import Deadline

__all__ = ["descend", "gradient_steps", "select"]


def select(model: Dynamics, candidates: Candidates, belief: Belief) -> Belief:
    """Line 2: theta_meta with the most likely embedding, h_likely = argmax log p(D_M | theta_meta, h) (eq. 12).

    Args:
        model: Holds theta_meta.
        candidates: The embeddings to select from.
        belief: Its posterior counts.
    """
    likeliest = belief.log_posterior.argmax(dim=1)  # (B,)
    theta_meta, h_likely = model.theta_of(len(likeliest)), candidates.chosen(likeliest[:, None])
    new = replace(belief, theta=theta_meta, h=h_likely, candidate=likeliest)
    return replace(new, recognised=torch.zeros_like(belief.recognised), adaptations=belief.adaptations + 1)


def gradient_steps(
    model: Dynamics,
    start: Belief,
    memory: Memory,
    settings: Adaptation,
    seed: int,
    deadline: Deadline | None = None,
) -> Belief:
    """Takes k steps from where a belief is, on all of the memory or on minibatches of it (line 3)."""
    if (steps := settings.gradient) is None:
        return start
    sample = _sample(steps.batch_size, seed, start.adaptations - 1, memory)
    return descend(model, start, memory, steps.inner_loop(memory.seen), steps.validation_size, sample, deadline)


def _sample(size: int, seed: int, number: int, memory: Memory) -> Sample:
    """Chooses what the steps of an adaptation see; the same for the same number, so that equal states act alike."""
    if not size:
        return whole_memory
    return minibatches(size, torch.Generator(memory.obs.device).manual_seed(1_000_003 * seed + number))


@torch.no_grad()
def descend(
    model: Dynamics,
    start: Belief,
    memory: Memory,
    inner_loop: InnerLoop,
    validation_size: int = 0,
    sample: Sample = whole_memory,
    deadline: Deadline | None = None,
) -> Belief:
    """Line 3: theta*, h* = k gradient steps from where a belief is, each member of the ensemble by itself.

    Args:
        model: Says what the parameters mean.
        start: Its theta and h are where the steps begin, and stay where they diverge, which is counted.
        memory: D_M.
        inner_loop: The k steps.
        validation_size: The newest transitions, which no gradient step sees. Steps that do not make them more likely
            are taken back, in each member of the ensemble by itself; 0 trusts all steps, as the paper does.
        sample: Chooses the transitions of each step among those it may see.
        deadline: By when to be done; steps for which there is no time are left out.
    """
    if inner_loop.steps == 0:
        return start
    seen, newest = memory.split(validation_size)
    theta, h, _ = inner_loop(model, start.theta, start.h, sample(model, seen), deadline)
    if validation_size:
        batch = whole_memory(model, newest)()
        better = model.loss(batch, h, theta) < model.loss(batch, start.h, start.theta)  # (B, P)
        theta = {name: choose(better, value, start.theta[name]) for name, value in theta.items()}
        h = choose(better, h, start.h)
    adapted = replace(start, theta=theta, h=h)
    return adapted.where(adapted.is_finite(), replace(start, diverged=start.diverged + 1))
