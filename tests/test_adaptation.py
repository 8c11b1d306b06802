from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent import FAMLE, Transitions
from famle_agent.adaptation import Belief, Memory, adapt, prior, situation_log_likelihood
from famle_agent.dynamics import Dynamics, expand
from famle_agent.inner_loop import InnerLoop

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


def memory_of(transitions: Transitions, rows: slice = slice(None)) -> Memory:
    """One robot per situation, with all of its transitions in its memory."""
    obs, action, next_obs = (
        torch.from_numpy(getattr(transitions, name)[rows]) for name in ("obs", "action", "next_obs")
    )
    return Memory(obs, action, next_obs, torch.ones(obs.shape[:2]))


def transition(value: float, robots: int) -> tuple[Tensor, Tensor, Tensor]:
    one = torch.full((robots, 1), value)
    return one, one + 0.1, one + 0.2


# --- the memory -------------------------------------------------------------------------------------------


@given(
    st.integers(1, 5),
    st.integers(1, 3).flatmap(
        lambda robots: st.lists(st.lists(st.booleans(), min_size=robots, max_size=robots), max_size=12)
    ),
)
def test_memory_keeps_the_last_transitions_in_order(size: int, valid: list[list[bool]]) -> None:
    robots = len(valid[0]) if valid else 1
    memory = Memory.empty(robots, size, obs_dim=1, action_dim=1, device=CPU)
    expected: list[deque[float]] = [deque(maxlen=size) for _ in range(robots)]
    for step, flags in enumerate(valid, start=1):
        memory = memory.add(*transition(float(step), robots), torch.tensor(flags))
        for robot in range(robots):
            if flags[robot]:
                expected[robot].append(float(step))
    for robot in range(robots):
        filled = memory.weight[robot] == 1
        assert memory.weight[robot].tolist() == [0.0] * (size - len(expected[robot])) + [1.0] * len(expected[robot])
        obs = torch.tensor(expected[robot])
        torch.testing.assert_close(memory.obs[robot, filled, 0], obs)
        torch.testing.assert_close(memory.action[robot, filled, 0], obs + 0.1)
        torch.testing.assert_close(memory.next_obs[robot, filled, 0], obs + 0.2)


def test_adding_leaves_the_old_memory_as_it_is() -> None:
    memory = Memory.empty(1, 3, 1, 1, CPU)
    memory.add(*transition(1.0, 1), torch.tensor([True]))
    assert memory.weight.sum() == 0
    assert memory.obs.sum() == 0


# --- the most likely situation ----------------------------------------------------------------------------


def test_embedding_of_the_situation_is_found(model: Dynamics, held_out: Transitions) -> None:
    belief = adapt(model, memory_of(held_out), INNER_LOOP, prior(model, 11))
    assert belief.posterior.argmax(dim=1).tolist() == list(range(11))
    assert belief.posterior.amax(dim=1).min() > 0.9
    assert belief.adaptations == 1


def test_likelihood_of_each_embedding_is_that_of_its_network(model: Dynamics, held_out: Transitions) -> None:
    memory = memory_of(held_out)
    data = model.encode(memory.obs, memory.action, memory.next_obs, memory.weight)
    together = situation_log_likelihood(model, data)
    assert together.shape == (11, 11)
    theta = expand(model.parameters_by_name(), 11)
    for situation in range(11):
        h = model.embeddings[situation].expand(11, -1)
        torch.testing.assert_close(
            together[:, situation], model.log_likelihood(theta, h, data).sum(dim=1), rtol=1e-4, atol=0.1
        )


def test_adaptation_lowers_the_loss(model: Dynamics, held_out: Transitions) -> None:
    memory = memory_of(held_out)
    memory = replace(memory, action=memory.action * torch.tensor([-0.5, 1.0, 1.0, 0.0, 1.0]))  # no training situation
    data = model.encode(memory.obs, memory.action, memory.next_obs)
    start = prior(model, 11)
    selected = adapt(model, memory, replace(INNER_LOOP, steps=0), start)
    adapted = adapt(model, memory, INNER_LOOP, start)
    losses = [model.loss(belief.theta, belief.h, data) for belief in (start, selected, adapted)]
    assert losses[1].mean() < losses[0].mean()
    assert (losses[2] < losses[1]).all()
    assert torch.equal(selected.h, model.embeddings[selected.posterior.argmax(dim=1)])


def test_robots_adapt_as_they_would_alone(model: Dynamics, held_out: Transitions) -> None:
    together = adapt(model, memory_of(held_out), INNER_LOOP, prior(model, 11))
    for robot in (0, 4, 10):
        rows = slice(robot, robot + 1)
        alone = adapt(model, memory_of(held_out, rows), INNER_LOOP, prior(model, 1))
        torch.testing.assert_close(alone.h, together.h[rows], rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(alone.log_likelihood, together.log_likelihood[rows], rtol=1e-3, atol=0.1)
        for name, value in alone.theta.items():
            torch.testing.assert_close(value, together.theta[name][rows], rtol=1e-3, atol=1e-3)


def test_adaptation_starts_from_what_was_meta_learned(model: Dynamics, held_out: Transitions) -> None:
    memory = memory_of(held_out)
    once = adapt(model, memory, INNER_LOOP, prior(model, 11))
    twice = adapt(model, memory, INNER_LOOP, once)
    assert torch.equal(once.h, twice.h)
    assert all(torch.equal(value, twice.theta[name]) for name, value in once.theta.items())
    assert twice.adaptations == 2


def test_empty_memory_says_nothing(model: Dynamics) -> None:
    start = prior(model, 2)
    belief = adapt(model, Memory.empty(2, 5, 12, 5, CPU), INNER_LOOP, start)
    torch.testing.assert_close(belief.posterior, torch.full((2, 11), 1 / 11))
    assert torch.equal(belief.h, start.h)
    torch.testing.assert_close(belief.theta["weight_0"], start.theta["weight_0"])


@pytest.mark.parametrize("error", [1.0, 1e3, 1e6, 1e12, 1e20])
def test_terrible_fit_leaves_a_posterior(model: Dynamics, held_out: Transitions, error: float) -> None:
    memory = memory_of(held_out)
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=memory.obs.shape).astype(np.float32))
    belief = adapt(model, replace(memory, next_obs=memory.obs + error * noise), INNER_LOOP, prior(model, 11))
    assert belief.posterior.isfinite().all()
    torch.testing.assert_close(belief.posterior.sum(dim=1), torch.ones(11))
    assert belief.h.isfinite().all()


# --- beliefs ----------------------------------------------------------------------------------------------


def test_prior_is_the_first_situation_and_all_are_as_likely(model: Dynamics) -> None:
    belief = prior(model, 3)
    assert torch.equal(belief.h, model.embeddings[:1].expand(3, -1))
    torch.testing.assert_close(belief.posterior, torch.full((3, 11), 1 / 11))
    assert belief.adaptations == 0


def make_belief(value: float, adaptations: int) -> Belief:
    theta = {"weight_0": torch.full((3, 2, 2), value), "bias_0": torch.full((3, 2), value)}
    return Belief(theta, torch.full((3, 4), value), torch.full((3, 5), value), adaptations)


@given(st.lists(st.booleans(), min_size=3, max_size=3))
def test_beliefs_are_mixed_by_robot(kept: list[bool]) -> None:
    mixed = make_belief(1.0, adaptations=4).where(torch.tensor(kept), make_belief(2.0, adaptations=0))
    expected = [1.0 if keep else 2.0 for keep in kept]
    for value in (*mixed.theta.values(), mixed.h, mixed.log_likelihood):
        assert value.flatten(1).amax(dim=1).tolist() == value.flatten(1).amin(dim=1).tolist() == expected
    assert mixed.adaptations == 4
