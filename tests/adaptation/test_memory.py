"""What robots have gone through, by which candidates are judged and of which gradient steps see a part."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent.adaptation.memory import Memory, minibatches, whole_memory
from famle_agent.models.dynamics import Batch, Dynamics

CPU = torch.device("cpu")


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


# --- what it says of candidates --------------------------------------------------------------------------


def random_memory(robots: int, size: int, candidates: int, seed: int) -> Memory:
    """Places of which some are empty; as many of the newest judge as the seed says."""
    chance, window = torch.Generator().manual_seed(seed), 1 + seed % size
    obs, action, next_obs = (torch.randn(robots, size, n, generator=chance) for n in (2, 1, 2))
    log_p, own = (torch.randn(robots, window, n, generator=chance) for n in (candidates, 1))
    weight = torch.rand(robots, size, generator=chance) > 0.3
    return Memory(obs, action, next_obs, log_p, own[..., 0], weight.float())


sizes = st.integers(1, 4), st.integers(1, 7), st.integers(1, 3), st.integers(0, 99)


@given(*sizes)
def test_robot_that_begins_anew_keeps_what_its_new_situation_explains_better(
    robots: int, size: int, candidates: int, seed: int
) -> None:
    old = random_memory(robots, size, candidates, seed)
    rows, candidate = torch.rand(robots) > 0.5, torch.randint(candidates, (robots,))
    new = old.begun_anew(rows, old.explained_by(candidate))
    for robot in range(robots):
        if rows[robot]:
            gain = (old.log_p[robot, :, candidate[robot]] - old.own_log_p[robot]) * old.judging[robot]
            since = [gain[t:].sum() for t in range(len(gain))]
            first = size - len(gain) + max(range(len(gain)), key=lambda t: (round(float(since[t]), 4), -t))
            assert new.weight[robot].sum() == old.weight[robot, first:].sum()
            assert torch.equal(new.weight[robot, first:], old.weight[robot, first:])
            assert torch.equal(new.own_log_p[robot], old.log_p[robot, :, candidate[robot]])
        else:
            assert torch.equal(new.weight[robot], old.weight[robot])
            assert torch.equal(new.own_log_p[robot], old.own_log_p[robot])
    assert new.obs is old.obs


@given(*sizes)
def test_newest_transitions_follow_those_of_an_older_memory(robots: int, size: int, candidates: int, seed: int) -> None:
    new, older = (random_memory(robots, size, candidates, one) for one in (seed, seed + 7 * size))
    n = torch.randint(new.judging.shape[1] + 1, (robots,))
    joined, rest = new.after(older, n), new.without_newest(n)
    for robot, newest in enumerate(n.tolist()):
        for name, values in vars(joined).items():
            places = values.shape[1]
            assert torch.equal(values[robot, places - newest :], getattr(new, name)[robot, places - newest :])
            assert torch.equal(values[robot, : places - newest], getattr(older, name)[robot, newest:])
        assert torch.equal(rest.weight[robot, : size - newest], new.weight[robot, : size - newest])
        assert not rest.weight[robot, size - newest :].any()


@given(*sizes)
def test_candidate_is_better_where_it_explains_what_counts_better(
    robots: int, size: int, candidates: int, seed: int
) -> None:
    seen, candidate = random_memory(robots, size, candidates, seed), torch.randint(candidates, (robots,))
    better = seen.better_explained(candidate)
    for robot in range(robots):
        counts = seen.weight[robot, -seen.own_log_p.shape[1] :] == 1
        theirs, own = seen.log_p[robot, counts, candidate[robot]].sum(), seen.own_log_p[robot, counts].sum()
        assert better[robot] == (theirs > own) or torch.isclose(theirs, own)


@given(*sizes)
def test_what_explains_as_well_as_the_belief_is_not_better(robots: int, size: int, candidates: int, seed: int) -> None:
    seen, everyone = random_memory(robots, size, candidates, seed), torch.ones(robots, dtype=torch.bool)
    candidate = torch.randint(candidates, (robots,))
    assert not seen.begun_anew(everyone, seen.explained_by(candidate)).better_explained(candidate).any()


@given(*sizes, st.integers(1, 9), st.integers(1, 9))
def test_resized_memory_keeps_the_newest(
    robots: int, size: int, candidates: int, seed: int, new_size: int, window: int
) -> None:
    old = random_memory(robots, size, candidates, seed)
    new = old.resized(new_size, window)
    assert new.weight.shape == (robots, new_size)
    assert new.log_p.shape == (robots, min(window, new_size), candidates)
    for name, values in vars(old).items():
        fitted = getattr(new, name)
        both = min(values.shape[1], fitted.shape[1])
        assert torch.equal(fitted[:, fitted.shape[1] - both :], values[:, values.shape[1] - both :])
        assert not fitted[:, : fitted.shape[1] - both].any()


@given(*sizes)
def test_only_what_judges_has_a_likelihood(robots: int, size: int, candidates: int, seed: int) -> None:
    seen = random_memory(robots, size, candidates, seed)
    window, new = seen.own_log_p.shape[1], torch.rand(robots, candidates)
    log_p, own = torch.cat([seen.log_p, new[:, None]], dim=1), torch.cat([seen.own_log_p, new[:, :1]], dim=1)
    everyone = torch.ones(robots, dtype=torch.bool)
    seen = seen.add(seen.obs[:, 0], seen.action[:, 0], seen.obs[:, 0], new, new[:, 0], valid=everyone)
    assert torch.equal(seen.log_p, log_p[:, -window:])
    assert torch.equal(seen.own_log_p, own[:, -window:])
    assert torch.equal(seen.judging, seen.weight[:, size - window :])


@given(st.lists(st.booleans(), min_size=1, max_size=4))
def test_memories_are_mixed_by_robot(kept: list[bool]) -> None:
    mine, theirs = (random_memory(len(kept), 3, 2, seed) for seed in (1, 4))
    mixed = mine.where(torch.tensor(kept), theirs)
    for robot, keep in enumerate(kept):
        for name, values in vars(mixed).items():
            assert torch.equal(values[robot], getattr(mine if keep else theirs, name)[robot])


# --- what a gradient step sees ----------------------------------------------------------------------------


def numbered(weight: Tensor) -> Memory:
    """Transitions whose observations say which they are."""
    obs = torch.arange(weight.numel(), dtype=torch.float32).view(*weight.shape, 1)
    return replace(Memory.full(obs, torch.zeros_like(obs), obs + 1.0, torch.zeros_like(obs)), weight=weight)


def model_of(members: int = 1) -> Dynamics:
    """A model that sees observations as they are."""
    return Dynamics(obs_dim=1, action_dim=1, n_situations=1, members=members)


def numbers(batch: Batch) -> Tensor:
    """Which transitions there are in a batch, (B, P, n) or (B, n)."""
    return batch.x[..., 0]


weights = st.lists(st.lists(st.booleans(), min_size=6, max_size=6), min_size=1, max_size=3)


@given(weights, st.integers(1, 8), st.integers(1, 2), st.integers(0, 99))
def test_minibatch_holds_what_counts_of_each_robot(
    robots: list[list[bool]], size: int, members: int, seed: int
) -> None:
    memory = numbered(torch.tensor(robots, dtype=torch.float32))
    batch = minibatches(size, torch.Generator().manual_seed(seed))(model_of(members), memory)()
    drawn = numbers(batch)
    assert drawn.shape == (len(robots), members, size)
    assert (batch.y == 1.0).all()
    for robot in range(len(drawn)):
        counted = memory.obs[robot, memory.weight[robot] == 1]
        if len(counted):
            assert (batch.weight[robot] == 1).all()
            assert set(drawn[robot].flatten().tolist()) <= set(counted.flatten().tolist())
        else:
            assert (batch.weight[robot] == 0).all()  # nothing that could be learnt from


@given(weights)
def test_all_that_counts_is_drawn_as_often(robots: list[list[bool]]) -> None:
    memory = numbered(torch.tensor(robots, dtype=torch.float32))
    batch = minibatches(3000, torch.Generator().manual_seed(0))(model_of(), memory)()
    for row, weight in enumerate(memory.weight):
        counts = torch.bincount(numbers(batch)[row, 0].long() - 6 * row, minlength=6) * batch.weight[row].mean()
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
    assert not torch.equal(of_members[:, 0], of_members[:, 1])


def test_whole_memory_is_what_all_members_see_each_time() -> None:
    memory = numbered(torch.tensor([[0.0, 1.0, 1.0], [1.0, 1.0, 1.0]]))
    draw = whole_memory(model_of(members=2), memory)
    batch = draw()
    assert torch.equal(numbers(batch), memory.obs[..., 0])
    assert torch.equal(batch.weight, memory.weight)
    assert draw() is batch


@given(weights, st.integers(0, 6))
def test_newest_transitions_are_split_off(robots: list[list[bool]], newest: int) -> None:
    memory = numbered(torch.tensor(robots, dtype=torch.float32))
    older, newer = memory.split(newest)
    assert torch.equal(older.weight + newer.weight, memory.weight)
    assert (older.weight[:, 6 - newest :] == 0).all()
    assert (newer.weight[:, : 6 - newest] == 0).all()
    assert torch.equal(older.obs, memory.obs)


@given(st.integers(1, 8))
def test_places_that_hold_nothing_are_none_of_the_newest(n: int) -> None:
    memory = replace(Memory.empty(1, 8, 1, 1, 2, CPU), weight=(torch.arange(8) >= 8 - n).float()[None])
    better = memory.own_log_p + 1.0
    assert memory.since(better).tolist() == [n]
    assert memory.without_newest(memory.since(better)).seen == 0
