from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent import FAMLE, Transitions
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.posterior import filtered_posterior, window_posterior
from tests.helpers import simple_model

Load = Callable[..., FAMLE]


def candidates_of(n: int, compose: bool = False) -> Candidates:
    return Candidates.of(simple_model(n_situations=n), compose)


def memory_with(log_p: Tensor, weight: Tensor) -> Memory:
    empty = torch.zeros(*log_p.shape[:2], 1)
    return replace(Memory.full(empty, empty, empty, log_p), weight=weight)


def filtered(candidates: Candidates, log_p: Tensor, hazard: float) -> list[Tensor]:
    """The posterior after each of the transitions (T, C)."""
    log_posterior, steps = candidates.log_prior[None], []
    for row in log_p:
        log_posterior = filtered_posterior(candidates, log_posterior, row[None], hazard)
        steps.append(torch.softmax(log_posterior, dim=1)[0])
    return steps


# --- the last M transitions -----------------------------------------------------------------------------------


@given(st.integers(1, 4), st.booleans(), st.integers(1, 5), st.integers(0, 100))
def test_window_counts_its_transitions_alike(n: int, compose: bool, size: int, seed: int) -> None:
    candidates, generator = candidates_of(n, compose), torch.Generator().manual_seed(seed)
    log_p = torch.randn(2, size, len(candidates.pairs), generator=generator)
    weight = (torch.rand(2, size, generator=generator) > 0.4).float()
    found = window_posterior(candidates, memory_with(log_p, weight))
    for robot in range(2):
        expected = candidates.log_prior + log_p[robot, weight[robot] == 1].sum(dim=0)
        torch.testing.assert_close(found[robot].softmax(dim=0), expected.softmax(dim=0))


# --- all transitions of a robot that may break ----------------------------------------------------------------


@pytest.mark.parametrize("compose", [False, True])
@pytest.mark.parametrize("hazard", [1e-4, 0.1, 0.7])
def test_filter_sums_over_everything_that_may_have_happened(compose: bool, hazard: float) -> None:
    """Against all sequences of situations, each as likely as the hazard makes it."""
    candidates = candidates_of(4 if compose else 3, compose)
    C = len(candidates.pairs)
    prior = candidates.log_prior.softmax(dim=0).double()
    log_p = 2 * torch.randn(3, C, generator=torch.Generator().manual_seed(1))
    stays = (1 - hazard) * torch.eye(C, dtype=torch.float64) + hazard * prior  # of each situation to each
    expected = torch.zeros(C, dtype=torch.float64)
    for path in product(range(C), repeat=3):
        chance = prior[path[0]]
        for step, situation in enumerate(path):
            chance = chance * log_p[step, situation].double().exp()
            chance = chance * (stays[path[step - 1], situation] if step else 1.0)
        expected[path[-1]] += chance
    found = filtered(candidates, log_p, hazard)[-1]
    torch.testing.assert_close(found, (expected / expected.sum()).float(), rtol=1e-4, atol=1e-6)


def test_filter_without_a_hazard_to_speak_of_is_a_window_over_everything() -> None:
    candidates, log_p = candidates_of(4), torch.randn(12, 4, generator=torch.Generator().manual_seed(0))
    window = window_posterior(candidates, memory_with(log_p[None], torch.ones(1, 12)))
    torch.testing.assert_close(filtered(candidates, log_p, 1e-12)[-1], window[0].softmax(dim=0), rtol=1e-3, atol=1e-5)


def test_filter_believes_in_a_break_within_a_few_steps() -> None:
    candidates, log_p = candidates_of(3), torch.zeros(120, 3)
    log_p[:60, 0] = log_p[60:, 2] = 2.0
    likely = [int(posterior.argmax()) for posterior in filtered(candidates, log_p, 1e-4)]
    assert set(likely[:60]) == {0}
    assert set(likely[67:]) == {2}
    slow = [
        int(window_posterior(candidates, memory_with(log_p[None, t - 50 : t], torch.ones(1, 50))).argmax())
        for t in range(60, 120)
    ]
    assert slow.index(2) > 20


@given(
    st.lists(st.lists(st.floats(-(2.0**99), 1024.0, width=32), min_size=3, max_size=3), min_size=1, max_size=6),
    st.floats(1e-9, 0.9),
)
def test_filter_always_gives_a_posterior(log_p: list[list[float]], hazard: float) -> None:
    for posterior in filtered(candidates_of(3), torch.tensor(log_p), hazard):
        assert posterior.isfinite().all()
        assert posterior.sum().item() == pytest.approx(1.0, abs=1e-4)


# --- of an agent ----------------------------------------------------------------------------------------------


def tell(agent: FAMLE, transitions: Transitions, situations: Any, steps: range) -> list[Tensor]:
    """The posterior after each step of one robot per situation."""
    beliefs = []
    for i in steps:
        arrays = (getattr(transitions, name)[situations, i] for name in ("obs", "action", "next_obs"))
        agent.observe(*arrays)
        beliefs.append(agent.belief.posterior)
    return beliefs


@pytest.mark.parametrize("hazard", [0.0, 1e-3])
def test_posterior_knows_of_each_transition_at_once(load_agent: Load, transitions: Transitions, hazard: float) -> None:
    """And not only every K steps, when the model is adapted to it."""
    agent = load_agent(hazard=hazard, adapt_every=5, adapt_steps=1, memory_size=20, selection_size=0)
    beliefs = tell(agent, transitions, [3, 8], range(12))
    assert agent.belief.adaptations == 2
    for earlier, later in zip([agent.adapter.initial(2).posterior, *beliefs], beliefs, strict=False):
        assert not torch.allclose(earlier, later, rtol=1e-6, atol=0.0)
    for belief in beliefs[-2:]:
        assert belief.argmax(dim=1).tolist() == [3, 8]


@pytest.mark.parametrize("hazard", [0.0, 1e-3])
def test_robot_without_a_transition_keeps_its_posterior(
    load_agent: Load, transitions: Transitions, hazard: float
) -> None:
    agent = load_agent(hazard=hazard, adapt_every=100, candidates=3, planner_iterations=1)
    obs, after = transitions.obs[[3, 8], 0], transitions.next_obs[[3, 8], 0]
    _, state = agent.predict(obs)
    _, state = agent.predict(after, state)
    _, reset = agent.predict(after, state, np.array([True, False]))
    assert torch.equal(reset.belief.posterior[0], state.belief.posterior[0])
    assert not torch.equal(reset.belief.posterior[1], state.belief.posterior[1])


def test_filter_sees_the_break_before_the_window_does(load_agent: Load, transitions: Transitions) -> None:
    steps = []
    for hazard in (0.0, 1e-3):
        agent = load_agent(hazard=hazard, adapt_every=1000, memory_size=50, selection_size=0)
        tell(agent, transitions, [3], range(50))
        likely = [int(belief.argmax()) for belief in tell(agent, transitions, [8], range(50, 100))]
        steps.append(likely.index(8))
    assert steps[1] < steps[0]


def test_power_of_the_likelihood_scales_the_evidence(load_agent: Load, transitions: Transitions) -> None:
    odds = []
    for power in (1.0, 0.5, 0.0):
        agent = load_agent(likelihood_power=power, adapt_every=1000)
        tell(agent, transitions, [3], range(4))
        log_posterior = agent.belief.log_posterior[0]
        odds.append(log_posterior - log_posterior[0])
    torch.testing.assert_close(odds[1], 0.5 * odds[0], rtol=1e-3, atol=1e-3)
    assert odds[0].abs().max() > 1
    assert odds[2].abs().max() < 1e-6


def test_agent_that_never_adapts_believes_what_it_did(load_agent: Load, transitions: Transitions) -> None:
    agent = load_agent(hazard=0.1)
    agent.config = agent.config.changed(adapt_every=0)
    before = agent.posterior()
    tell(agent, transitions, [3], range(5))
    assert agent.posterior() == before
