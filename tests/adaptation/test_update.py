from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent import FAMLE, Transitions
from famle_agent.adaptation.belief import Belief, prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.posterior import window_posterior
from famle_agent.adaptation.update import descend, select
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from tests.helpers import adapted, memory_of, simple_model

INNER_LOOP = InnerLoop(steps=10, lr=1e-3, embedding_lr=0.05, optimizer="adam")
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def held_out() -> Transitions:
    """Transitions of the reacher's training situations that no agent has learned from."""
    agent = FAMLE("reacher", seed=77, device="cpu", transitions_per_situation=40)
    transitions = agent.collect()
    agent.get_env().close()
    return transitions


@pytest.fixture(scope="module")
def model(agent_file: str) -> Iterator[Dynamics]:
    agent = FAMLE.load(agent_file, device="cpu")
    assert agent.dynamics is not None
    yield agent.dynamics
    agent.get_env().close()


@pytest.fixture(scope="module")
def candidates(model: Dynamics) -> Candidates:
    return Candidates.of(model, compose=False)


def tensors_of(transitions: Transitions, rows: slice = slice(None)) -> list[Tensor]:
    """One robot per situation, with all of its transitions."""
    return [torch.from_numpy(getattr(transitions, name)[rows]) for name in ("obs", "action", "next_obs")]


# --- the most likely situation ----------------------------------------------------------------------------


def test_embedding_of_the_situation_is_found(model: Dynamics, candidates: Candidates, held_out: Transitions) -> None:
    belief = adapted(model, candidates, memory_of(model, candidates, *tensors_of(held_out)), INNER_LOOP)
    assert belief.posterior.argmax(dim=1).tolist() == list(range(11))
    assert belief.posterior.amax(dim=1).min() > 0.9
    assert belief.adaptations == 1


def test_adaptation_lowers_the_loss(model: Dynamics, candidates: Candidates, held_out: Transitions) -> None:
    obs, action, next_obs = tensors_of(held_out)
    action = action * torch.tensor([-0.5, 1.0, 1.0, 0.0, 1.0])  # no training situation
    memory, data = memory_of(model, candidates, obs, action, next_obs), model.encode(obs, action, next_obs)
    start, loops = prior(model, candidates, 11), (replace(INNER_LOOP, steps=0), INNER_LOOP)
    selected, after = (adapted(model, candidates, memory, loop) for loop in loops)
    losses = [model.loss(data, belief.h, belief.theta) for belief in (start, selected, after)]
    assert losses[1].mean() < losses[0].mean()
    assert (losses[2] < losses[1]).all()
    likely = model.embeddings[0, selected.posterior.argmax(dim=1)].detach()
    torch.testing.assert_close(selected.h[:, 0], likely, rtol=0, atol=1e-5)


def test_robots_adapt_as_they_would_alone(model: Dynamics, candidates: Candidates, held_out: Transitions) -> None:
    together = adapted(model, candidates, memory_of(model, candidates, *tensors_of(held_out)), INNER_LOOP)
    for robot in (0, 4, 10):
        rows = slice(robot, robot + 1)
        alone = adapted(model, candidates, memory_of(model, candidates, *tensors_of(held_out, rows)), INNER_LOOP)
        torch.testing.assert_close(alone.h, together.h[rows], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(alone.log_posterior, together.log_posterior[rows], rtol=1e-3, atol=0.1)
        for name, value in alone.theta.items():
            torch.testing.assert_close(value, together.theta[name][rows], rtol=1e-3, atol=1e-3)


def test_adaptation_starts_from_what_was_meta_learned(
    model: Dynamics, candidates: Candidates, held_out: Transitions
) -> None:
    memory = memory_of(model, candidates, *tensors_of(held_out))
    once = adapted(model, candidates, memory, INNER_LOOP)
    twice = descend(model, select(model, candidates, once), memory, INNER_LOOP)
    assert torch.equal(once.h, twice.h)
    assert all(torch.equal(value, twice.theta[name]) for name, value in once.theta.items())
    assert twice.adaptations == 2


def test_selection_takes_an_embedding_and_what_was_meta_learned(
    model: Dynamics, candidates: Candidates, held_out: Transitions
) -> None:
    memory, start = memory_of(model, candidates, *tensors_of(held_out)), prior(model, candidates, 11)
    belief = replace(start, log_posterior=window_posterior(candidates, memory))
    selected = select(model, candidates, belief)
    assert selected.adaptations == belief.adaptations + 1
    likely = model.embeddings[0, belief.posterior.argmax(dim=1)].detach()
    torch.testing.assert_close(selected.h[:, 0], likely, rtol=0, atol=1e-5)
    assert all(torch.equal(value, start.theta[name]) for name, value in selected.theta.items())


def test_each_member_begins_with_its_own_embedding_of_the_likeliest_situation() -> None:
    several = simple_model(n_situations=4, members=4)
    candidates = Candidates.of(several, compose=False)
    log_posterior = torch.tensor([[0.4, 0.3, 0.2, 0.1], [0.1, 0.1, 0.7, 0.1]]).log()
    selected = select(several, candidates, replace(prior(several, candidates, 2), log_posterior=log_posterior))
    assert selected.candidate.tolist() == [0, 2]
    torch.testing.assert_close(selected.h[0], several.embeddings[:, 0])
    torch.testing.assert_close(selected.h[1], several.embeddings[:, 2])


def test_descent_goes_on_from_where_a_belief_is(model: Dynamics, candidates: Candidates, held_out: Transitions) -> None:
    memory, plain = memory_of(model, candidates, *tensors_of(held_out)), replace(INNER_LOOP, optimizer="sgd")
    start = prior(model, candidates, 11)
    once = descend(model, start, memory, plain)
    twice = descend(model, once, memory, plain)
    both = descend(model, start, memory, replace(plain, steps=20))
    torch.testing.assert_close(twice.h, both.h)
    torch.testing.assert_close(twice.theta, both.theta)
    assert descend(model, once, memory, replace(plain, steps=0)) is once
    assert twice.adaptations == start.adaptations  # who adapts counts


def test_descent_that_diverges_stays_where_it_was(
    model: Dynamics, candidates: Candidates, held_out: Transitions
) -> None:
    memory, start = memory_of(model, candidates, *tensors_of(held_out)), prior(model, candidates, 11)
    adrift = descend(model, start, memory, InnerLoop(steps=50, lr=1e6, embedding_lr=1e6))
    assert adrift.is_finite().all()
    assert torch.equal(adrift.h, start.h)


def test_empty_memory_says_nothing(model: Dynamics, candidates: Candidates) -> None:
    start = prior(model, candidates, 2)
    belief = adapted(model, candidates, Memory.empty(2, 5, 12, 5, 11, CPU), INNER_LOOP)
    torch.testing.assert_close(belief.posterior, torch.full((2, 11), 1 / 11))
    assert torch.equal(belief.h, start.h)
    torch.testing.assert_close(belief.theta["weight_0"], start.theta["weight_0"])


def test_places_that_are_empty_do_not_count(model: Dynamics, candidates: Candidates, held_out: Transitions) -> None:
    """Whatever stands there: neither in the posterior nor in the gradient."""
    full = memory_of(model, candidates, *tensors_of(held_out, slice(3, 4)))
    part = memory_of(model, candidates, *(values[:, 30:] for values in tensors_of(held_out, slice(3, 4))))
    padded = replace(full, weight=(torch.arange(40) >= 30).float()[None])
    one, other = (adapted(model, candidates, memory, INNER_LOOP) for memory in (part, padded))
    torch.testing.assert_close(one.log_posterior, other.log_posterior)
    torch.testing.assert_close(one.h, other.h, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("error", [1.0, 1e3, 1e6, 1e12, 1e20])
def test_terrible_fit_leaves_a_posterior(
    model: Dynamics, candidates: Candidates, held_out: Transitions, error: float
) -> None:
    obs, action, _ = tensors_of(held_out)
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=obs.shape).astype(np.float32))
    memory = memory_of(model, candidates, obs, action, obs + error * noise)
    belief = adapted(model, candidates, memory, INNER_LOOP)
    assert belief.posterior.isfinite().all()
    torch.testing.assert_close(belief.posterior.sum(dim=1), torch.ones(11))
    assert belief.h.isfinite().all()


# --- beliefs ----------------------------------------------------------------------------------------------


def test_prior_is_the_first_situation_and_all_are_as_likely(model: Dynamics, candidates: Candidates) -> None:
    belief = prior(model, candidates, 3)
    assert torch.equal(belief.h[:, 0], model.embeddings[:, 0].expand(3, -1))
    torch.testing.assert_close(belief.posterior, torch.full((3, 11), 1 / 11))
    assert belief.adaptations == 0


def make_belief(value: float, adaptations: int, members: int = 1) -> Belief:
    axes = (3, members)
    theta = {"weight_0": torch.full((*axes, 2, 2), value), "bias_0": torch.full((*axes, 2), value)}
    h, log_posterior, candidate = torch.full((*axes, 4), value), torch.full((3, 5), value), torch.full((3,), int(value))
    excess = torch.full((3, 2), value)
    bias = excess[:, None, None].expand(-1, members, log_posterior.shape[1], -1)
    diverged, recognised = torch.zeros_like(candidate), torch.zeros_like(candidate, dtype=torch.bool)
    return Belief(theta, h, log_posterior, bias, excess, candidate, diverged, recognised, adaptations)


@given(st.lists(st.booleans(), min_size=3, max_size=3), st.integers(1, 3))
def test_beliefs_are_mixed_by_robot(kept: list[bool], members: int) -> None:
    mixed = make_belief(1.0, 4, members).where(torch.tensor(kept), make_belief(2.0, 0, members))
    expected = [1.0 if keep else 2.0 for keep in kept]
    for value in (
        *mixed.theta.values(),
        mixed.h,
        mixed.log_posterior,
        mixed.bias,
        mixed.excess,
        mixed.candidate[:, None],
    ):
        assert value.flatten(1).amax(dim=1).tolist() == value.flatten(1).amin(dim=1).tolist() == expected
    assert mixed.adaptations == 4


@pytest.mark.parametrize("part", ["theta", "h"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_one_member_that_is_not_finite_spoils_its_robot(part: str, bad: float) -> None:
    belief = make_belief(1.0, adaptations=1, members=2)
    assert belief.is_finite().tolist() == [True, True, True]
    (belief.h if part == "h" else belief.theta["bias_0"])[1, 1, 0] = bad
    assert belief.is_finite().tolist() == [True, False, True]
