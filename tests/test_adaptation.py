from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent import FAMLE, Transitions
from famle_agent.adaptation import Belief, Candidates, adapt, descend, prior, select, window_posterior
from famle_agent.dynamics import Batch, Dynamics
from famle_agent.inner_loop import InnerLoop
from famle_agent.memory import Memory, Sample, minibatches, whole_memory
from tests.helpers import adapted, memory_of

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


def transition(value: float, robots: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    one = torch.full((robots, 1), value)
    return one, one + 0.1, one + 0.2, torch.cat([one + 0.3, one + 0.4], dim=1), one[:, 0] + 0.5


# --- the memory -------------------------------------------------------------------------------------------


@given(
    st.integers(1, 5),
    st.integers(1, 3).flatmap(
        lambda robots: st.lists(st.lists(st.booleans(), min_size=robots, max_size=robots), max_size=12)
    ),
)
def test_memory_keeps_the_last_transitions_in_order(size: int, valid: list[list[bool]]) -> None:
    robots = len(valid[0]) if valid else 1
    memory = Memory.empty(robots, size, obs_dim=1, action_dim=1, candidates=2, device=CPU)
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
        torch.testing.assert_close(memory.log_p[robot, filled], torch.stack([obs + 0.3, obs + 0.4], dim=1))
        torch.testing.assert_close(memory.own_log_p[robot, filled], obs + 0.5)


def test_adding_leaves_the_old_memory_as_it_is() -> None:
    memory = Memory.empty(1, 3, 1, 1, 2, CPU)
    memory.add(*transition(1.0, 1), torch.tensor([True]))
    assert memory.weight.sum() == 0
    assert memory.obs.sum() == 0
    assert memory.log_p.sum() == 0


memories = st.integers(1, 4).flatmap(
    lambda robots: st.lists(st.lists(st.booleans(), min_size=robots, max_size=robots), min_size=1, max_size=9)
)
"""Which robots have a transition at each step, for memories of 5."""


def remembered(valid: list[list[bool]]) -> tuple[Memory, list[list[Tensor]]]:
    """A memory of 5, and what stands in it: the observations of each robot's last transitions, (2, 3) each."""
    torch.manual_seed(len(valid))
    robots = len(valid[0])
    memory, seen = Memory.empty(robots, 5, 3, 1, 2, CPU), [list[Tensor]() for _ in range(robots)]
    for flags in valid:
        obs, next_obs, action, log_p = (torch.randn(robots, size) for size in (3, 3, 1, 2))
        memory = memory.add(obs, action, next_obs, log_p, torch.randn(robots), torch.tensor(flags))
        for robot in range(robots):
            seen[robot] += [torch.stack([obs[robot], next_obs[robot]])] * flags[robot]
    return memory, [rows[-5:] for rows in seen]


@given(memories)
def test_memory_knows_how_much_it_has_seen_and_how_far_it_went(valid: list[list[bool]]) -> None:
    memory, seen = remembered(valid)
    assert memory.seen == max(len(rows) for rows in seen)
    low, high = memory.range()
    for robot, rows in enumerate(seen):
        if rows:
            assert torch.equal(low[robot], torch.cat(rows).amin(dim=0))
            assert torch.equal(high[robot], torch.cat(rows).amax(dim=0))
        else:
            assert (low[robot] == -torch.inf).all()
            assert (high[robot] == torch.inf).all()


# --- what a gradient step sees ----------------------------------------------------------------------------


def numbered(weight: Tensor) -> Memory:
    """Transitions whose observations say which they are."""
    obs = torch.arange(weight.numel(), dtype=torch.float32).view(*weight.shape, 1)
    return replace(Memory.full(obs, torch.zeros_like(obs), obs + 1.0, torch.zeros_like(obs)), weight=weight)


def model_of(members: int = 1) -> Dynamics:
    """A model that sees observations as they are."""
    return Dynamics(obs_dim=1, action_dim=1, n_situations=1, members=members)


def numbers(batch: Batch) -> Tensor:
    """Which transitions there are in a batch, (rows, n)."""
    return batch.x[..., 0]


weights = st.lists(st.lists(st.booleans(), min_size=6, max_size=6), min_size=1, max_size=3)


@given(weights, st.integers(1, 8), st.integers(1, 2), st.integers(0, 99))
def test_minibatch_holds_what_counts_of_each_robot(
    robots: list[list[bool]], size: int, members: int, seed: int
) -> None:
    memory = numbered(torch.tensor(robots, dtype=torch.float32))
    batch = minibatches(size, torch.Generator().manual_seed(seed))(model_of(members), memory)()
    drawn = numbers(batch)
    assert drawn.shape == (len(robots) * members, size)
    assert (batch.y == 1.0).all()
    for row in range(len(drawn)):
        counted = memory.obs[row // members, memory.weight[row // members] == 1]
        if len(counted):
            assert (batch.weight[row] == 1).all()
            assert set(drawn[row].tolist()) <= set(counted.flatten().tolist())
        else:
            assert (batch.weight[row] == 0).all()  # nothing that could be learnt from


@given(weights)
def test_all_that_counts_is_drawn_as_often(robots: list[list[bool]]) -> None:
    memory = numbered(torch.tensor(robots, dtype=torch.float32))
    batch = minibatches(3000, torch.Generator().manual_seed(0))(model_of(), memory)()
    for row, weight in enumerate(memory.weight):
        counts = torch.bincount(numbers(batch)[row].long() - 6 * row, minlength=6) * batch.weight[row].mean()
        torch.testing.assert_close(counts, 3000 * weight / weight.sum().clamp(min=1), rtol=0.2, atol=0.0)


def test_rows_and_steps_draw_by_themselves() -> None:
    memory = numbered(torch.ones(2, 50))

    def draws(members: int = 1) -> Callable[[], Batch]:
        return minibatches(20, torch.Generator().manual_seed(0))(model_of(members), memory)

    draw, again = draws(), draws()
    one, other = numbers(draw()), numbers(draw())
    assert not torch.equal(one[0], one[1] - 50)
    assert not torch.equal(one, other)
    assert torch.equal(numbers(again()), one)
    of_members = numbers(draws(members=2)())
    assert not torch.equal(of_members[0], of_members[1])


def test_whole_memory_is_what_each_member_sees_each_time() -> None:
    memory = numbered(torch.tensor([[0.0, 1.0, 1.0], [1.0, 1.0, 1.0]]))
    draw = whole_memory(model_of(members=2), memory)
    batch = draw()
    assert torch.equal(numbers(batch), memory.obs[[0, 0, 1, 1], :, 0])
    assert torch.equal(batch.weight, memory.weight[[0, 0, 1, 1]])
    assert draw() is batch


@given(weights, st.integers(0, 6))
def test_newest_transitions_are_split_off(robots: list[list[bool]], newest: int) -> None:
    memory = numbered(torch.tensor(robots, dtype=torch.float32))
    older, newer = memory.split(newest)
    assert torch.equal(older.weight + newer.weight, memory.weight)
    assert (older.weight[:, 6 - newest :] == 0).all()
    assert (newer.weight[:, : 6 - newest] == 0).all()
    assert torch.equal(older.obs, memory.obs)


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
    losses = [model.loss(belief.theta, belief.h, data) for belief in (start, selected, after)]
    assert losses[1].mean() < losses[0].mean()
    assert (losses[2] < losses[1]).all()
    likely = model.embeddings[0, selected.posterior.argmax(dim=1)].detach()
    torch.testing.assert_close(selected.h, likely, rtol=0, atol=1e-5)


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
    twice = adapt(model, candidates, memory, INNER_LOOP, once)
    assert torch.equal(once.h, twice.h)
    assert all(torch.equal(value, twice.theta[name]) for name, value in once.theta.items())
    assert twice.adaptations == 2


@pytest.mark.parametrize("spread", [False, True])
@pytest.mark.parametrize("validation_size", [0, 10])
def test_adaptation_is_selection_and_descent(
    model: Dynamics, candidates: Candidates, held_out: Transitions, validation_size: int, spread: bool
) -> None:
    memory, start = memory_of(model, candidates, *tensors_of(held_out)), prior(model, candidates, 11)
    belief = replace(start, log_posterior=window_posterior(candidates, memory))

    def sample() -> Sample:
        return minibatches(8, torch.Generator().manual_seed(1))

    whole = adapt(model, candidates, memory, INNER_LOOP, belief, validation_size, spread, sample())
    selected = select(model, candidates, belief, spread)
    parts = descend(model, selected, memory, INNER_LOOP, validation_size, sample())
    assert torch.equal(whole.h, parts.h)
    assert all(torch.equal(value, parts.theta[name]) for name, value in whole.theta.items())
    assert whole.adaptations == selected.adaptations == parts.adaptations == belief.adaptations + 1
    likely = model.embeddings[0, belief.posterior.argmax(dim=1)].detach()
    assert torch.allclose(selected.h, likely, atol=1e-5) or spread
    assert all(torch.equal(value, start.theta[name]) for name, value in selected.theta.items())
    assert not torch.equal(whole.h, selected.h)


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
    assert torch.equal(belief.h, model.embeddings[:, 0].expand(3, -1))
    torch.testing.assert_close(belief.posterior, torch.full((3, 11), 1 / 11))
    assert belief.adaptations == 0


def make_belief(value: float, adaptations: int, members: int = 1) -> Belief:
    rows = 3 * members
    theta = {"weight_0": torch.full((rows, 2, 2), value), "bias_0": torch.full((rows, 2), value)}
    h, log_posterior, candidate = torch.full((rows, 4), value), torch.full((3, 5), value), torch.full((3,), int(value))
    return Belief(theta, h, log_posterior, candidate, adaptations)


@given(st.lists(st.booleans(), min_size=3, max_size=3), st.integers(1, 3))
def test_beliefs_are_mixed_by_robot(kept: list[bool], members: int) -> None:
    mixed = make_belief(1.0, 4, members).where(torch.tensor(kept), make_belief(2.0, 0, members))
    expected = [1.0 if keep else 2.0 for keep in kept]
    for value in (*mixed.theta.values(), mixed.h, mixed.log_posterior, mixed.candidate[:, None]):
        rows = [number for number in expected for _ in range(len(value) // 3)]
        assert value.flatten(1).amax(dim=1).tolist() == value.flatten(1).amin(dim=1).tolist() == rows
    assert mixed.adaptations == 4


@pytest.mark.parametrize("part", ["theta", "h"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_one_member_that_is_not_finite_spoils_its_robot(part: str, bad: float) -> None:
    belief = make_belief(1.0, adaptations=1, members=2)
    assert belief.is_finite().tolist() == [True, True, True]
    (belief.h if part == "h" else belief.theta["bias_0"])[3, 1] = bad
    assert belief.is_finite().tolist() == [True, False, True]
