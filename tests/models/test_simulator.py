"""The fast path equals the plain one, whatever the model; and what candidate sequences yield."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent.models.dynamics import Dynamics
from famle_agent.models.members import for_robots
from famle_agent.models.reward import Objective
from famle_agent.models.simulator import Simulator, imagine
from tests.helpers import models, random_h, random_theta, random_transitions

# --- one step ---------------------------------------------------------------------------------------------


@given(models(), st.integers(1, 3), st.integers(1, 6), st.booleans())
def test_fast_path_equals_the_plain_one(model: Dynamics, robots: int, n: int, own_data: bool) -> None:
    """In double precision, in which no more than rounding is between them."""
    theta = {name: value.double() for name, value in random_theta(model, robots).items()}
    model, h = model.double(), random_h(model, robots).double()
    axes = (robots, model.members, n) if own_data else (robots, n)
    obs, action = (values.double() for values in random_transitions(model, *axes)[:2])
    expected = model.predict(obs, action, h, theta)
    assert expected.shape == (robots, model.members, n, model.obs_dim)
    torch.testing.assert_close(Simulator(model, h, theta)(obs, action), expected, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(Simulator(model, h)(obs, action), model.predict(obs, action, h), rtol=1e-9, atol=1e-9)


@given(models(), st.integers(1, 6))
def test_fast_path_equals_the_plain_one_in_single_precision(model: Dynamics, n: int) -> None:
    h = model.embeddings_of(torch.tensor([0]))
    obs, action, _ = random_transitions(model, 1, n)
    torch.testing.assert_close(
        Simulator(model, h)(obs, action), model.predict(obs, action, h, model.theta_of(1)), rtol=1e-3, atol=1e-3
    )


@given(models(), st.data())
def test_fast_path_of_robots_with_networks_of_their_own(model: Dynamics, data: st.DataObject) -> None:
    chosen = data.draw(st.lists(st.integers(0, model.members - 1), min_size=2, max_size=3))
    together = for_robots(model.double(), chosen)
    obs, action = (values.double() for values in random_transitions(model, len(chosen), 4)[:2])
    h = together.embeddings_of(torch.zeros(len(chosen), dtype=torch.long))
    expected = together.predict(obs, action, h).detach()
    torch.testing.assert_close(Simulator(together, h)(obs, action), expected, rtol=1e-9, atol=1e-9)


def test_embedding_matters() -> None:
    torch.manual_seed(0)
    model = Dynamics(3, 2, n_situations=2)
    obs, action, _ = random_transitions(model, 1, 4)
    one, other = (Simulator(model, model.embeddings_of(torch.tensor([c])))(obs, action) for c in (0, 1))
    assert (one - other).abs().min() > 0


@given(models(), st.integers(1, 3))
def test_candidates_are_independent(model: Dynamics, robots: int) -> None:
    # In double precision: in single, batches of another size round otherwise by more than the comparison allows.
    theta = {name: value.double() for name, value in random_theta(model, robots).items()}
    simulator = Simulator(model.double(), random_h(model, robots).double(), theta)
    obs, action = (values.double() for values in random_transitions(model, robots, 5)[:2])
    torch.testing.assert_close(simulator(obs, action)[:, :, 2:3], simulator(obs[:, 2:3], action[:, 2:3]))


@given(models(), st.integers(1, 3), st.integers(1, 4))
def test_prediction_within_a_range_is_the_nearest_in_it(model: Dynamics, robots: int, n: int) -> None:
    h, (obs, action, _) = random_h(model, robots), random_transitions(model, robots, n)
    low, high = torch.sort(torch.randn(2, robots, model.obs_dim), dim=0).values
    free = Simulator(model, h)(obs, action)
    limited = Simulator(model, h, within=(low, high))(obs, action)
    assert torch.equal(limited, torch.maximum(torch.minimum(free, high[:, None, None]), low[:, None, None]))
    boundless = Simulator(model, h, within=(low - math.inf, high + math.inf))(obs, action)
    assert torch.equal(boundless, free)


# --- what candidates yield --------------------------------------------------------------------------------


def last_position(_: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
    return next_obs.sum(dim=-1)


@given(models(), st.integers(1, 3), st.integers(1, 5), st.integers(1, 3))
def test_return_is_the_mean_over_members_of_the_sum_of_rewards(
    model: Dynamics, robots: int, candidates: int, horizon: int
) -> None:
    model, h = model.double(), random_h(model, robots).double()
    obs = torch.randn(robots, model.obs_dim, dtype=torch.float64)
    actions = torch.rand(robots, candidates, horizon, model.action_dim, dtype=torch.float64) * 2 - 1
    state = obs[:, None, None].expand(-1, model.members, candidates, -1)
    expected = torch.zeros(robots, model.members, candidates, dtype=torch.float64)
    for t in range(horizon):
        own = actions[:, None, :, t].expand(-1, model.members, -1, -1)
        state = model.predict(state, own, h, model.theta_of(robots))
        expected += last_position(obs, own, state)
    found = Simulator(model, h).returns(Objective(last_position), obs, actions)
    torch.testing.assert_close(found, expected.mean(dim=1), rtol=1e-6, atol=1e-6)


@given(models(), st.integers(1, 4))
def test_robots_that_share_networks_are_judged_as_with_copies_of_them(model: Dynamics, robots: int) -> None:
    """Each in its own situation, with a reward of its own."""
    model, h = model.double(), random_h(model, robots).double()
    obs = torch.randn(robots, model.obs_dim, dtype=torch.float64)
    actions = torch.rand(robots, 3, 2, model.action_dim, dtype=torch.float64) * 2 - 1
    wanted = torch.randn(robots, 1, 1, dtype=torch.float64)
    returns = []
    for theta in (None, model.theta_of(robots)):
        simulator = Simulator(model, h, theta)
        assert torch.equal(simulator.of_robots(simulator.rows(h)), h)
        own = simulator.rows(wanted)  # (B * P, 1)
        objective = Objective(lambda obs, action, next_obs, own=own: own * next_obs.sum(dim=-1))  # type: ignore[misc]
        returns.append(simulator.returns(objective, obs, actions))
    torch.testing.assert_close(*returns, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_one_member_that_diverges_is_enough(bad: float) -> None:
    """The worst return for the robot that it is of, and for no other."""
    torch.manual_seed(0)
    model = Dynamics(2, 1, n_situations=1, members=2)
    theta = {name: value.clone() for name, value in model.theta_of(2).items()}
    theta["bias_0"][0, 1] = bad
    simulator = Simulator(model, model.embeddings_of(torch.zeros(2, dtype=torch.long)), theta)
    returns = simulator.returns(Objective(last_position), torch.zeros(2, 2), torch.zeros(2, 3, 4, 1))
    assert (returns[0] == -math.inf).all()
    assert returns[1].isfinite().all()


def test_many_candidates_are_judged_as_a_few() -> None:
    torch.manual_seed(0)
    model = Dynamics(2, 2, n_situations=1, members=2)
    simulator = Simulator(model, model.embeddings_of(torch.zeros(2, dtype=torch.long)))
    obs, actions = torch.randn(2, 2), torch.rand(2, 1500, 2, 2)
    together = simulator.returns(Objective(last_position), obs, actions)
    parts = [simulator.returns(Objective(last_position), obs, part) for part in actions.split(100, dim=1)]
    torch.testing.assert_close(together, torch.cat(parts, dim=1))


def point_mass(obs: Tensor, action: Tensor) -> Tensor:
    """A point in the plane whose velocity is the action."""
    return obs + 0.1 * action


def test_return_is_the_sum_of_the_rewards() -> None:
    actions, obs = torch.rand(2, 3, 4, 2), torch.randn(2, 2)

    def reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        torch.testing.assert_close(next_state, point_mass(state, action))
        return state.sum(dim=-1) + 10 * action.sum(dim=-1)

    expected = torch.zeros(2, 3)
    for b in range(2):
        for n in range(3):
            state = obs[b]
            for action in actions[b, n]:
                expected[b, n] += state.sum() + 10 * action.sum()
                state = point_mass(state, action)
    torch.testing.assert_close(imagine(point_mass, Objective(reward), obs, actions), expected)


@pytest.mark.parametrize(("networks", "candidates"), [(1, 1), (2, 3), (2, 2000), (3000, 70)])
@pytest.mark.parametrize("discount", [0.0, 0.9, 1.0])
def test_return_is_discounted_ends_with_the_episode_and_looks_beyond(
    networks: int, candidates: int, discount: float
) -> None:
    torch.manual_seed(0)
    obs, actions = torch.rand(networks, 2), torch.rand(networks, candidates, 4, 2)

    def reward(state: Tensor, action: Tensor, next_state: Tensor) -> Tensor:
        return (state * next_state).sum(dim=-1) - action[..., 0]

    def ends(state: Tensor) -> Tensor:
        return state[..., 0] > 0.8

    state, expected = obs[:, None].expand(-1, candidates, -1), torch.zeros(networks, candidates)
    goes_on = torch.ones(networks, candidates)
    for t in range(4):
        next_state = point_mass(state, actions[:, :, t])
        expected += discount**t * goes_on * reward(state, actions[:, :, t], next_state)
        state, goes_on = next_state, goes_on * ~ends(next_state)
    expected += discount**4 * goes_on * 5.0 * state[..., 1]
    objective = Objective(reward, ends, lambda state: 5.0 * state[..., 1], discount)
    torch.testing.assert_close(imagine(point_mass, objective, obs, actions), expected)


def test_reward_may_be_a_number_and_may_differ_between_robots() -> None:
    obs, actions = torch.zeros(2, 2), torch.rand(2, 3, 4, 2)
    same = imagine(point_mass, Objective(lambda obs, action, next_obs: 0.5), obs, actions)  # type: ignore[arg-type,return-value]
    torch.testing.assert_close(same, torch.full((2, 3), 2.0))
    of_each = torch.tensor([1.0, -1.0])[:, None]
    own = imagine(point_mass, Objective(lambda obs, action, next_obs: of_each * action[..., 0]), obs, actions)
    torch.testing.assert_close(own, of_each * actions[..., 0].sum(dim=2))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_return_that_is_no_number_is_the_worst(bad: float) -> None:
    actions = torch.tensor([[[[bad]], [[0.0]]]])
    total = imagine(point_mass, Objective(lambda obs, action, next_obs: action[..., 0]), torch.zeros(1, 1), actions)
    assert total.tolist() == [[-math.inf, 0.0]]
