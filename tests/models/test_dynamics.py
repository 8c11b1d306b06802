from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F  # noqa: N812 (torch's own custom)

from famle_agent.models.dynamics import Dynamics
from famle_agent.models.simulator import Simulator
from tests.helpers import log_likelihood, models, random_h, random_theta, random_transitions, rows_of, simple_model

# --- one code path for one and for many -----------------------------------------------------------------


@given(models(), st.integers(1, 4), st.integers(1, 6))
def test_robots_in_a_batch_equal_each_alone(model: Dynamics, size: int, n: int) -> None:
    theta, h = random_theta(model, size), random_h(model, size)
    obs, action, next_obs = random_transitions(model, size, n)
    weight = (torch.rand(size, n) > 0.3).float()
    data = model.encode(obs, action, next_obs, weight)
    loss, density = model.loss(data, h, theta), log_likelihood(model, data, h, theta)
    predicted = model.predict(obs, action, h, theta)
    assert loss.shape == (size, model.members)
    assert density.shape == (size, n)
    assert predicted.shape == (size, model.members, n, model.obs_dim)
    for i in range(size):
        rows = slice(i, i + 1)
        alone = model.encode(obs[rows], action[rows], next_obs[rows], weight[rows])
        one = rows_of(theta, rows)
        torch.testing.assert_close(model.loss(alone, h[rows], one), loss[rows])
        torch.testing.assert_close(log_likelihood(model, alone, h[rows], one), density[rows], rtol=1e-5, atol=1e-4)
        torch.testing.assert_close(model.predict(obs[rows], action[rows], h[rows], one), predicted[rows])


@given(models(), st.integers(1, 3), st.integers(2, 6))
def test_each_row_may_have_an_embedding_of_its_own(model: Dynamics, size: int, n: int) -> None:
    theta, x = random_theta(model, size), torch.randn(size, n, model.n_features + model.action_dim)
    h = torch.randn(size, model.members, n, model.embeddings.shape[-1])
    together = model(x, h, theta)
    for row in range(n):
        alone = model(x[:, row : row + 1], h[:, :, row], theta)
        torch.testing.assert_close(together[:, :, row : row + 1], alone, rtol=1e-4, atol=1e-4)


@given(models(), st.integers(1, 3), st.integers(1, 4))
def test_members_may_have_data_of_their_own(model: Dynamics, size: int, n: int) -> None:
    theta, h, P = random_theta(model, size), random_h(model, size), model.members
    obs, action, next_obs = random_transitions(model, size, P, n)
    own = model.encode(obs, action, next_obs)
    loss, predicted = model.loss(own, h, theta), model.predict(obs, action, h, theta)
    for member in range(P):
        alone = model.encode(obs[:, member], action[:, member], next_obs[:, member])
        torch.testing.assert_close(model.loss(alone, h, theta)[:, member], loss[:, member])
        one = model.predict(obs[:, member], action[:, member], h, theta)[:, member]
        torch.testing.assert_close(one, predicted[:, member])


@given(models(), st.integers(1, 3))
def test_prediction_is_where_the_targets_lead(model: Dynamics, size: int) -> None:
    theta, h = random_theta(model, size), random_h(model, size)
    obs, action, _ = random_transitions(model, size, 4)
    change = model(model.inputs(obs, action), h, theta) * model.target_std + model.target_mean
    expected = model.layout.advance(obs[:, None].expand(-1, model.members, -1, -1), change.clone())
    torch.testing.assert_close(model.predict(obs, action, h, theta), expected)


@pytest.mark.parametrize("shape", [(2, 5), (2, 1, 5), (1, 2, 3, 1, 5)])
def test_embeddings_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    model, h = simple_model(members=2), torch.randn(shape)
    for call in (lambda: model(torch.randn(2, 3, 5), h), lambda: Simulator(model, h)):
        with pytest.raises(ValueError, match=r"must have shape \(B, 2, embedding_dim\).*embeddings_of"):
            call()


# --- parameters -------------------------------------------------------------------------------------------


@given(models(), st.integers(1, 3))
def test_without_theta_a_model_uses_its_own_and_learns(model: Dynamics, size: int) -> None:
    h, x = random_h(model, size), torch.randn(size, 5, model.n_features + model.action_dim)
    torch.testing.assert_close(model(x, h), model(x, h, model.theta_of(size)))
    model(x, h).sum().backward()
    assert all(value.grad is not None for value in model.theta.values())
    assert not model(x, h, model.theta_of(size)).requires_grad


@given(models(), st.integers(1, 4))
def test_each_robot_has_all_members_without_a_copy(model: Dynamics, size: int) -> None:
    for name, value in model.theta_of(size).items():
        own = model.theta[name]
        assert value.shape == (size, model.members, *own.shape[1:])
        assert value.data_ptr() == own.data_ptr()
        assert not value.requires_grad
        for robot in range(size):
            assert torch.equal(value[robot], own)


def test_members_are_independent_networks() -> None:
    model = simple_model(members=3, interaction_rank=2)
    theta, h = model.theta_of(1), model.embeddings_of(torch.tensor([1]))
    data = model.encode(*random_transitions(model, 1, 6))
    before = model.loss(data, h, theta)[0]
    assert len(set(before.tolist())) == 3  # they begin differently
    for name in theta:
        changed = {key: value.clone() for key, value in theta.items()}
        changed[name][0, 1] += 0.1
        after = model.loss(data, h, changed)[0]
        assert torch.equal(after[[0, 2]], before[[0, 2]])
        assert after[1] != before[1]


@given(models(), st.lists(st.integers(0, 3), min_size=1, max_size=6))
def test_single_embedding_is_that_of_all_situations(model: Dynamics, situations: list[int]) -> None:
    c = torch.tensor(situations) % max(model.n_situations, 4 * (model.n_situations == 1))
    index = model.embedding_index(c)
    assert index.tolist() == (c.tolist() if model.n_situations > 1 else [0] * len(c))
    expected = model.embeddings.detach()[:, index].transpose(0, 1)
    assert torch.equal(model.embeddings_of(c), expected)
    rows = model.embeddings_by_row(c.expand(1, model.members, -1))
    assert torch.equal(rows[0].transpose(0, 1), expected)
    assert rows.requires_grad


def test_embeddings_of_situations_are_those_of_each_member() -> None:
    model = simple_model(members=2)
    h, c = model.embeddings_of(torch.tensor([3, 0, 3])), (3, 0, 3)
    assert h.shape == (3, 2, model.embeddings.shape[-1])
    for robot in range(3):
        for member in range(2):
            assert torch.equal(h[robot, member], model.embeddings[member, c[robot]])
    assert not h.requires_grad


# --- angles -----------------------------------------------------------------------------------------------


@given(
    st.floats(-math.pi, math.pi),
    st.floats(-3.0, 3.0),
    st.integers(-2, 2),
    st.integers(-2, 2),
)
def test_full_turns_of_an_angle_change_nothing(angle: float, change: float, turns: int, next_turns: int) -> None:
    model = simple_model(obs_dim=2, angle_dims=[1]).double()
    h = model.embeddings_of(torch.tensor([0]))
    obs, action = torch.tensor([[[0.3, angle]]], dtype=torch.float64), torch.rand(1, 1, 2, dtype=torch.float64)
    next_obs = torch.tensor([[[0.1, angle + change]]], dtype=torch.float64)
    turn = torch.tensor([0.0, 2 * math.pi], dtype=torch.float64)
    data = model.encode(obs, action, next_obs)
    turned = model.encode(obs + turns * turn, action, next_obs + next_turns * turn)
    torch.testing.assert_close(model.loss(turned, h), model.loss(data, h))
    torch.testing.assert_close(log_likelihood(model, turned, h), log_likelihood(model, data, h))
    for predict in (partial(model.predict, h=h), Simulator(model, h)):
        one, other = predict(obs, action), predict(obs + turns * turn, action) - turns * turn
        torch.testing.assert_close(one, other)


def test_step_across_the_jump_is_as_small_as_any_other() -> None:
    model = simple_model(obs_dim=1, angle_dims=[0])
    obs, next_obs = (
        torch.tensor([[math.pi - 0.05], [0.0], [-math.pi + 0.05]]),
        torch.tensor([[-math.pi + 0.05], [0.1], [math.pi - 0.05]]),
    )
    torch.testing.assert_close(
        model.layout.change(obs, next_obs), torch.tensor([[0.1], [0.1], [-0.1]]), atol=1e-5, rtol=0
    )
    assert obs.tolist()[0][0] == pytest.approx(math.pi - 0.05)  # the data are not touched


def test_features_are_the_other_dimensions_and_sine_and_cosine() -> None:
    model = simple_model(obs_dim=3, angle_dims=[1])
    features = model.layout.features(torch.tensor([[2.0, math.pi / 2, 5.0]]))
    torch.testing.assert_close(features, torch.tensor([[2.0, 5.0, 1.0, 0.0]]), atol=1e-6, rtol=0)


# --- quaternions ------------------------------------------------------------------------------------------


def quaternions(*shape: int) -> torch.Tensor:
    return F.normalize(torch.randn(*shape, 4, dtype=torch.float64), dim=-1)


def posed(others: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Observations of five dimensions: one number, then a quaternion."""
    return torch.cat([others, q], dim=-1)


@given(st.integers(0, 1000), st.sampled_from([-1.0, 1.0]), st.sampled_from([-1.0, 1.0]))
def test_orientation_is_the_same_for_q_and_minus_q(seed: int, sign: float, next_sign: float) -> None:
    model = simple_model(obs_dim=5, quaternion_dims=(1, 2, 3, 4)).double()
    torch.manual_seed(seed)
    q, q_next, other = quaternions(2, 3), quaternions(2, 3), torch.randn(2, 3, 1, dtype=torch.float64)
    obs, next_obs = posed(other, q), posed(other + 0.2, q_next)
    turned, next_turned = posed(other, sign * q), posed(other + 0.2, next_sign * q_next)
    torch.testing.assert_close(model.layout.features(turned), model.layout.features(obs))
    target, expected = model.layout.change(turned, next_turned), model.layout.change(obs, next_obs)
    torch.testing.assert_close(target[..., :1], expected[..., :1])
    torch.testing.assert_close(target[..., 1:], sign * expected[..., 1:])
    reached = turned + target
    torch.testing.assert_close(model.layout.features(reached), model.layout.features(next_obs))
    assert (target[..., 1:].norm(dim=-1) <= math.sqrt(2) + 1e-9).all()  # the short way round


def test_quaternion_enters_as_the_products_of_its_parts() -> None:
    model = simple_model(obs_dim=5, quaternion_dims=(1, 2, 3, 4))
    features = model.layout.features(torch.tensor([[7.0, 0.1, 0.2, 0.3, 0.4]]))
    products = [0.01, 0.02, 0.03, 0.04, 0.04, 0.06, 0.08, 0.09, 0.12, 0.16]
    torch.testing.assert_close(features, torch.tensor([[7.0, *products]]))
    assert model.n_features == 11


def test_rotation_is_linear_in_the_products() -> None:
    """A turn of the sensor maps the features of all orientations by one matrix."""
    model = simple_model(obs_dim=4, quaternion_dims=(0, 1, 2, 3)).double()
    torch.manual_seed(0)
    q, c, s = quaternions(40), math.cos(0.3), math.sin(0.3)
    x, y, z, w = q.unbind(dim=-1)
    turned = torch.stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z], dim=-1)
    solution = torch.linalg.lstsq(model.layout.features(q[:20]), model.layout.features(turned[:20])).solution
    torch.testing.assert_close(model.layout.features(q[20:]) @ solution, model.layout.features(turned[20:]))


def test_observations_are_not_touched() -> None:
    model = simple_model(obs_dim=5, quaternion_dims=(1, 2, 3, 4), angle_dims=(0,))
    obs, _, next_obs = random_transitions(model, 3, 4)
    before, next_before = obs.clone(), -next_obs
    model.layout.change(obs, -next_obs)
    assert torch.equal(obs, before)
    assert torch.equal(-next_obs, next_before)


# --- normalisation ----------------------------------------------------------------------------------------


def test_normalised_data_have_mean_zero_and_deviation_one() -> None:
    model = simple_model()
    obs, action, next_obs = random_transitions(model, 4, 500)
    obs, next_obs = obs * torch.tensor([1.0, 10.0, 0.01]) + 7, next_obs * torch.tensor([1.0, 10.0, 0.01]) + 7
    model.fit_normalisation(obs, action, next_obs)
    data = model.encode(obs, action, next_obs)
    for values in (data.x[..., :3], data.y):
        torch.testing.assert_close(values.mean(dim=(0, 1)), torch.zeros(3), atol=1e-3, rtol=0)
        torch.testing.assert_close(values.flatten(0, 1).std(dim=0), torch.ones(3), atol=1e-3, rtol=0)
    assert torch.equal(data.x[..., 3:], action)
    assert torch.equal(data.weight, torch.ones(4, 500))


@given(st.floats(-1e4, 1e4, width=32))
def test_dimension_that_never_varies_is_not_blown_up(constant: float) -> None:
    model = simple_model()
    obs, action, next_obs = random_transitions(model, 4, 50)
    obs[..., 1] = next_obs[..., 1] = constant
    model.fit_normalisation(obs, action, next_obs)
    data = model.encode(obs + torch.tensor([0.0, 1.0, 0.0]), action, next_obs)
    assert data.x[..., 1].abs().max() < 2
    assert data.y[..., 1].abs().max() < 2
