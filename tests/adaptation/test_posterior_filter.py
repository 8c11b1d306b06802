from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from famle_agent import FAMLE
from famle_agent.adaptation.adapters import EmbeddingAdapter
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.posterior import filtered_posterior
from famle_agent.adaptation.settings import Adaptation, Filter
from tests.helpers import random_transitions, run, simple_model

hazards = st.floats(1e-6, 0.5)


def filtered(candidates: Candidates, log_p: torch.Tensor, hazard: float) -> torch.Tensor:
    """The posterior after each of n transitions of one robot, (n, C)."""
    log_posterior, history = candidates.log_prior[None], []
    for row in log_p:
        log_posterior = filtered_posterior(candidates, log_posterior, row[None], hazard)
        history.append(log_posterior.exp()[0])
    return torch.stack(history)


@pytest.mark.parametrize("nu", [0.0, 4.0])
@torch.no_grad()
def test_steps_of_the_filter_are_the_equations_of_its_docstring(nu: float) -> None:
    model = simple_model(n_situations=3, members=2, degrees_of_freedom=nu)
    model.noise_std.copy_(0.2 + torch.rand_like(model.noise_std))
    eta, power, places = 0.01, 0.5, 20
    adapter = EmbeddingAdapter(model, Adaptation(evidence=Filter(eta), compose=True, likelihood_power=power), seed=0)
    belief, moved = adapter.initial(1), torch.ones(1, dtype=torch.bool)
    w_0 = adapter.candidates.log_prior.double().exp().numpy()
    memory = Memory.empty(1, places, model.obs_dim, model.action_dim, len(w_0), torch.device("cpu"), 10)
    w, b, e = w_0, np.zeros((2, len(w_0), 3)), np.ones(3)
    for t in range(30):
        transition = [values[:, 0] for values in random_transitions(model, 1, 1)]
        evidence = adapter.judge(belief, *transition)
        memory = memory.add(*transition, evidence.log_p, evidence.own_log_p, moved)
        belief = adapter.infer(memory, belief, evidence, moved)
        r, n = evidence.residual[0].double().numpy(), min(t + 1, places)  # (P, C, obs_dim)
        f, v = r - b, np.maximum(1.0, e)
        log_density = stats.t(nu).logpdf if nu else stats.norm.logpdf
        log_p = power * log_density(f / np.sqrt(v)).sum(axis=2).mean(axis=0)  # (C,)
        u = (nu + 1) / (nu + f**2 / v) if nu else 1.0
        q = (w[:, None] * (u * f**2).mean(axis=0)).sum(axis=0)  # (obs_dim,)
        w = ((1 - eta) * w + eta * w_0) * np.exp(log_p - log_p.max())
        w, b, e = w / w.sum(), b + (r - b) / min(n, 10), e + (q - e) / (10 + min(n, 100))
        for found, expected in ((belief.posterior, w), (belief.bias, b), (belief.excess, e)):
            np.testing.assert_allclose(found[0].numpy(), expected, rtol=1e-3, atol=1e-4)


@given(hazards, st.booleans(), st.integers(0, 1000))
def test_filter_is_that_of_a_hidden_markov_model(hazard: float, compose: bool, seed: int) -> None:
    candidates = Candidates.of(simple_model(n_situations=4), compose)
    prior = candidates.log_prior.exp()
    log_p = torch.randn(6, len(prior), generator=torch.Generator().manual_seed(seed))
    transition = (1 - hazard) * torch.eye(len(prior)) + hazard * prior.expand(len(prior), -1)
    expected = prior
    for row, posterior in zip(log_p, filtered(candidates, log_p, hazard), strict=True):
        expected = (expected @ transition) * row.exp()
        expected = expected / expected.sum()
        torch.testing.assert_close(posterior, expected)


@given(st.integers(5, 200))
def test_break_is_believed_as_soon_however_long_the_robot_was_intact(intact_steps: int) -> None:
    candidates = Candidates.of(simple_model(n_situations=3), compose=False)
    evidence = torch.tensor([[4.0, 0.0, 0.0]]).repeat(intact_steps, 1)
    broken = torch.tensor([[0.0, 4.0, 0.0]]).repeat(5, 1)
    believed = filtered(candidates, torch.cat([evidence, broken]), hazard=1e-4).argmax(dim=1)
    assert (believed[:intact_steps] == 0).all()
    assert (believed[intact_steps + 3 :] == 1).all()  # 1e-4 is outweighed after log(1e4 * 3) / 4 steps


def test_impossible_evidence_leaves_a_posterior() -> None:
    candidates = Candidates.of(simple_model(n_situations=3), compose=False)
    worst = torch.full((4, 3), -1e30)
    worst[:, 2] = -0.5e30
    posterior = filtered(candidates, worst, hazard=1e-4)
    assert posterior.isfinite().all()
    assert (posterior.argmax(dim=1) == 2).all()


@pytest.mark.parametrize("hazard", [1.0, -0.1, math.inf])
def test_hazard_is_a_probability(hazard: float, load_agent: Callable[..., FAMLE]) -> None:
    with pytest.raises(ValueError, match="hazard"):
        load_agent(hazard=hazard)


def test_filtering_agent_names_the_situation_and_notices_the_break(load_agent: Callable[..., FAMLE]) -> None:
    quick = {"adapt_steps": 0, "candidates": 20, "planner_iterations": 1, "adapt_every": 1}
    agent = load_agent(hazard=1e-4, likelihood_power=0.3, **quick)
    env = agent.get_env().envs[0]
    state = run(agent, env, 10)
    posterior = agent.posterior(state)
    assert max(posterior, key=lambda name: posterior[name]) == "intact"

    env.unwrapped.set_situation("joint 0 reversed")
    obs = env.unwrapped.observe()
    state = agent.predict(obs, None)[1] if state is None else state
    for _ in range(8):
        action, state = agent.predict(obs, state)
        obs, *_ = env.step(action)
    posterior = agent.posterior(state)
    assert max(posterior, key=lambda name: posterior[name]) == "joint 0 reversed"
