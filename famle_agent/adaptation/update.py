"""Lines 6 and 7 of Algorithm 2: the most likely embedding, then k gradient steps on theta and h."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from famle_agent.adaptation.belief import Belief, choose
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory, Sample, whole_memory
from famle_agent.adaptation.posterior import systematic_sample
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import Anchor, InnerLoop

__all__ = ["adapt", "descend", "select"]

_GOLDEN_RATIO = 0.5 * (math.sqrt(5.0) - 1.0)  # multiples of it, less their whole part, fill [0, 1) evenly


def adapt(
    model: Dynamics,
    candidates: Candidates,
    memory: Memory,
    inner_loop: InnerLoop,
    belief: Belief,
    validation_size: int = 0,
    spread: bool = False,
    sample: Sample = whole_memory,
) -> Belief:
    """Lines 6 and 7 of Algorithm 2 for B robots at once.

    Args:
        model: Holds theta_meta and H_meta.
        candidates: The embeddings to select from.
        memory: D_M.
        inner_loop: k steps of gradient descent; where they diverge, theta_meta and the embedding stay, and the belief
            counts it.
        belief: Its posterior counts; theta* and h* are found anew.
        validation_size: As for :func:`descend`.
        spread: As for :func:`select`.
        sample: As for :func:`descend`.
    """
    return descend(model, select(model, candidates, belief, spread), memory, inner_loop, validation_size, sample)


def select(model: Dynamics, candidates: Candidates, belief: Belief, spread: bool = False) -> Belief:
    """Line 6: theta_meta with the most likely embedding, h_likely = argmax log p(D_M | theta_meta, h).

    Args:
        model: Holds theta_meta.
        candidates: The embeddings to select from.
        belief: Its posterior counts.
        spread: Whether the members of the ensemble begin with candidates that are sampled from the posterior, others
            each time, instead of all with the most likely one. A plan has to be good then in several situations that
            may be the case, and a robot that is stuck tries what it would do in another one.
    """
    robots, members = len(belief.log_posterior), model.members
    networks = torch.arange(len(candidates.h), device=candidates.h.device).view(-1, members)  # (R, P)
    likeliest = belief.log_posterior.argmax(dim=1)
    likely = likeliest[:, None].expand(-1, members)
    if spread:
        likely = systematic_sample(belief.posterior, members, offset=belief.adaptations * _GOLDEN_RATIO % 1.0)
    h_likely = candidates.h[networks, likely].flatten(0, 1)
    theta_meta = model.theta_of(robots)
    return Belief(theta_meta, h_likely, belief.log_posterior, likeliest, belief.diverged, belief.adaptations + 1)


@torch.no_grad()
def descend(
    model: Dynamics,
    start: Belief,
    memory: Memory,
    inner_loop: InnerLoop,
    validation_size: int = 0,
    sample: Sample = whole_memory,
) -> Belief:
    """Line 7: theta*, h* = k gradient steps from where a belief is, each member of the ensemble by itself.

    Args:
        model: Says what the parameters mean.
        start: Its theta and h are where the steps begin, and stay where they diverge, which is counted.
        memory: D_M.
        inner_loop: The k steps; theta_meta is their anchor.
        validation_size: The newest transitions, which no gradient step sees. Steps that do not make them more likely
            are taken back, in each member of the ensemble by itself; 0 trusts all steps, as the paper does.
        sample: Chooses the transitions of each step among those it may see.
    """
    if inner_loop.steps == 0:
        return start
    seen, newest = memory.split(validation_size)
    anchor = _anchor(model, seen) if inner_loop.decay else None
    theta, h, _ = inner_loop(model, start.theta, start.h, sample(model, seen), anchor)
    if validation_size:
        batch = whole_memory(model, newest)()
        better = model.loss(theta, h, batch) < model.loss(start.theta, start.h, batch)
        theta = {name: choose(better, value, start.theta[name]) for name, value in theta.items()}
        h = choose(better, h, start.h)
    adapted = replace(start, theta=theta, h=h)
    return adapted.where(adapted.is_finite(), replace(start, diverged=start.diverged + 1))


def _anchor(model: Dynamics, memory: Memory) -> Anchor:
    """What the networks of B robots are drawn back to: theta_meta, (B * P, ...)."""
    n = memory.weight.sum(dim=1)
    return Anchor(model.theta_of(len(n)), n.repeat_interleave(model.members))
