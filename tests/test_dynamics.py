from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own custom)

from famle_agent.dynamics import Batch, Dynamics, Theta, expand


@st.composite
def models(draw: st.DrawFn) -> Dynamics:
    """Models of many shapes, with a normalisation that is not the identity."""
    obs_dim, action_dim = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    torch.manual_seed(draw(st.integers(0, 1000)))
    model = Dynamics(
        obs_dim,
        action_dim,
        n_situations=draw(st.integers(1, 5)),
        embedding_dim=draw(st.integers(1, 4)),
        hidden=draw(st.lists(st.integers(1, 9), min_size=1, max_size=3)),
        angle_dims=draw(st.lists(st.integers(0, obs_dim - 1), unique=True)),
        gate_actions=draw(st.booleans()),
    )
    model.fit_normalisation(3 + 2 * torch.randn(50, obs_dim), 3 + 2 * torch.randn(50, obs_dim))
    model.noise_std.copy_(torch.rand(obs_dim) + 0.5)
    return model


def random_theta(model: Dynamics, size: int) -> Theta:
    return {name: torch.randn(size, *value.shape) for name, value in model.parameters_by_name().items()}


def random_transitions(model: Dynamics, *shape: int) -> tuple[Tensor, Tensor, Tensor]:
    obs = torch.randn(*shape, model.obs_dim)
    return obs, torch.rand(*shape, model.action_dim) * 2 - 1, obs + 0.3 * torch.randn_like(obs)


def simple_model(**kwargs: Any) -> Dynamics:
    torch.manual_seed(0)
    return Dynamics(**{"obs_dim": 3, "action_dim": 2, "n_situations": 4, "hidden": (8, 8), **kwargs})


def of(theta: Theta, i: int) -> Theta:
    return {name: value[i : i + 1] for name, value in theta.items()}


# --- one code path for one and for many -----------------------------------------------------------------


@given(models(), st.integers(1, 4), st.integers(1, 6))
def test_networks_in_a_batch_equal_each_alone(model: Dynamics, size: int, n: int) -> None:
    theta, h = random_theta(model, size), torch.randn(size, model.embeddings.shape[1])
    obs, action, next_obs = random_transitions(model, size, n)
    weight = (torch.rand(size, n) > 0.3).float()
    data = model.encode(obs, action, next_obs, weight)
    loss, density = model.loss(theta, h, data), model.log_likelihood(theta, h, data)
    predicted = model.simulator(theta, h)(obs, action)
    assert loss.shape == (size,)
    assert density.shape == (size, n)
    for i in range(size):
        row = slice(i, i + 1)
        alone = model.encode(obs[row], action[row], next_obs[row], weight[row])
        torch.testing.assert_close(model.loss(of(theta, i), h[row], alone), loss[row])
        torch.testing.assert_close(model.log_likelihood(of(theta, i), h[row], alone), density[row])
        torch.testing.assert_close(model.simulator(of(theta, i), h[row])(obs[row], action[row]), predicted[row])


@given(models(), st.integers(1, 4), st.integers(1, 6))
def test_simulator_predicts_what_the_network_does(model: Dynamics, size: int, n: int) -> None:
    theta, h = random_theta(model, size), torch.randn(size, model.embeddings.shape[1])
    obs, action, next_obs = random_transitions(model, size, n)
    data = model.encode(obs, action, next_obs)
    change = model.forward(model.network(theta, h), data.x) * model.target_std + model.target_mean
    torch.testing.assert_close(model.simulator(theta, h)(obs, action), obs + change, rtol=1e-4, atol=1e-4)


@given(models(), st.integers(1, 3))
def test_rollouts_of_candidates_are_independent(model: Dynamics, size: int) -> None:
    theta, h = random_theta(model, size), torch.randn(size, model.embeddings.shape[1])
    obs, action, _ = random_transitions(model, size, 5)
    simulator = model.simulator(theta, h)
    torch.testing.assert_close(simulator(obs, action)[:, 2:3], simulator(obs[:, 2:3], action[:, 2:3]))


def test_expand_shows_the_same_parameters_often() -> None:
    theta = simple_model().parameters_by_name()
    for name, value in expand(theta, 3).items():
        assert value.shape == (3, *theta[name].shape)
        assert value.data_ptr() == theta[name].data_ptr()
        assert not value.requires_grad


# --- the model is the paper's -----------------------------------------------------------------------------


def test_embedding_is_concatenated_to_the_input() -> None:
    model = simple_model(gate_actions=False, embedding_dim=5, hidden=(7,))
    theta, h = random_theta(model, 2), torch.randn(2, 5)
    x = torch.randn(2, 6, model.n_features + model.action_dim)
    first = torch.cat([theta["weight_0"], theta["embedding"]], dim=1)
    inputs = torch.cat([x, h[:, None].expand(-1, 6, -1)], dim=-1)
    hidden = F.silu(inputs @ first + theta["bias_0"][:, None])
    expected = hidden @ theta["weight_1"] + theta["bias_1"][:, None]
    torch.testing.assert_close(model.forward(model.network(theta, h), x), expected)


def test_paper_network_has_no_gate() -> None:
    assert "gate" not in simple_model(gate_actions=False).theta
    assert simple_model(gate_actions=True).theta["gate"].shape == (5, 2)


@pytest.mark.parametrize("gain", [-1.0, 0.0, 0.4])
def test_gate_expresses_the_gain_of_each_motor(gain: float) -> None:
    model = simple_model(embedding_dim=2)
    theta = expand(model.parameters_by_name(), 1)
    theta["embedding"] = torch.zeros_like(theta["embedding"])  # h acts through the gate alone
    theta["gate"] = torch.eye(2)[None]
    obs, action, _ = random_transitions(model, 1, 6)
    broken = model.simulator(theta, torch.tensor([[0.0, gain - 1.0]]))(obs, action)
    intact = model.simulator(theta, torch.zeros(1, 2))(obs, action * torch.tensor([1.0, gain]))
    torch.testing.assert_close(broken, intact)


def test_loss_is_half_the_mean_squared_error() -> None:
    model = simple_model()
    theta, h = expand(model.parameters_by_name(), 1), model.embeddings[:1]
    data = model.encode(*random_transitions(model, 1, 9))
    error = model.forward(model.network(theta, h), data.x) - data.y
    torch.testing.assert_close(model.loss(theta, h, data), 0.5 * error.square().mean()[None])


@given(models(), st.integers(1, 4))
def test_log_likelihood_is_that_of_a_normal_distribution(model: Dynamics, n: int) -> None:
    theta, h = random_theta(model, 2), torch.randn(2, model.embeddings.shape[1])
    data = model.encode(*random_transitions(model, 2, n))
    normal = torch.distributions.Normal(model.forward(model.network(theta, h), data.x), model.noise_std)
    expected = normal.log_prob(data.y).sum(dim=-1)
    torch.testing.assert_close(model.log_likelihood(theta, h, data), expected, rtol=1e-4, atol=1e-4)


def test_fitted_noise_is_the_most_likely() -> None:
    model = simple_model()
    data = model.encode(*random_transitions(model, 4, 200))
    model.fit_noise(data)
    theta = expand(model.parameters_by_name(), 4)
    best, fitted = model.log_likelihood(theta, model.embeddings, data).sum(), model.noise_std.clone()
    for factor in (0.9, 1.1):
        model.noise_std.copy_(factor * fitted)
        assert model.log_likelihood(theta, model.embeddings, data).sum() < best


def test_fitted_noise_of_an_exact_model_is_above_zero() -> None:
    model = simple_model()
    theta = expand(model.parameters_by_name(), 4)
    x = torch.randn(4, 20, 5)
    data = Batch(x, model.forward(model.network(theta, model.embeddings), x), torch.ones(4, 20))
    model.fit_noise(data)
    assert model.noise_std.min() > 0
    assert model.log_likelihood(theta, model.embeddings, data).isfinite().all()


@given(models(), st.integers(1, 5), st.integers(1, 5))
def test_padding_changes_nothing(model: Dynamics, n: int, padding: int) -> None:
    theta, h = random_theta(model, 2), torch.randn(2, model.embeddings.shape[1])
    real, noise = random_transitions(model, 2, n), random_transitions(model, 2, padding)
    weight = torch.cat([torch.ones(2, n), torch.zeros(2, padding)], dim=1)
    padded = model.encode(*(torch.cat([a, b], dim=1) for a, b in zip(real, noise, strict=True)), weight)
    data = model.encode(*real)
    torch.testing.assert_close(model.loss(theta, h, padded), model.loss(theta, h, data))
    density = model.log_likelihood(theta, h, padded)
    torch.testing.assert_close(density[:, :n], model.log_likelihood(theta, h, data))
    assert (density[:, n:] == 0).all()


def test_nothing_but_padding_has_no_loss() -> None:
    model = simple_model()
    data = model.encode(*random_transitions(model, 1, 3), torch.zeros(1, 3))
    assert model.loss(expand(model.parameters_by_name(), 1), model.embeddings[:1], data).item() == 0


# --- angles -----------------------------------------------------------------------------------------------


@given(
    st.floats(-math.pi, math.pi),
    st.floats(-3.0, 3.0),
    st.integers(-2, 2),
    st.integers(-2, 2),
)
def test_full_turns_of_an_angle_change_nothing(angle: float, change: float, turns: int, next_turns: int) -> None:
    model = simple_model(obs_dim=2, angle_dims=[1]).double()
    theta, h = expand(model.parameters_by_name(), 1), model.embeddings[:1]
    obs, action = torch.tensor([[[0.3, angle]]], dtype=torch.float64), torch.rand(1, 1, 2, dtype=torch.float64)
    next_obs = torch.tensor([[[0.1, angle + change]]], dtype=torch.float64)
    turn = torch.tensor([0.0, 2 * math.pi], dtype=torch.float64)
    data = model.encode(obs, action, next_obs)
    turned = model.encode(obs + turns * turn, action, next_obs + next_turns * turn)
    torch.testing.assert_close(model.loss(theta, h, turned), model.loss(theta, h, data))
    torch.testing.assert_close(model.log_likelihood(theta, h, turned), model.log_likelihood(theta, h, data))
    simulator = model.simulator(theta, h)
    one, other = simulator(obs, action) - next_obs, simulator(obs + turns * turn, action) - next_obs - turns * turn
    torch.testing.assert_close(one, other)


def test_step_across_the_jump_is_as_small_as_any_other() -> None:
    model = simple_model(obs_dim=1, angle_dims=[0])
    obs, next_obs = (
        torch.tensor([[math.pi - 0.05], [0.0], [-math.pi + 0.05]]),
        torch.tensor([[-math.pi + 0.05], [0.1], [math.pi - 0.05]]),
    )
    torch.testing.assert_close(model.targets(obs, next_obs), torch.tensor([[0.1], [0.1], [-0.1]]), atol=1e-5, rtol=0)
    assert obs.tolist()[0][0] == pytest.approx(math.pi - 0.05)  # the data are not touched


def test_features_are_the_other_dimensions_and_sine_and_cosine() -> None:
    model = simple_model(obs_dim=3, angle_dims=[1])
    features = model.features(torch.tensor([[2.0, math.pi / 2, 5.0]]))
    torch.testing.assert_close(features, torch.tensor([[2.0, 5.0, 1.0, 0.0]]), atol=1e-6, rtol=0)


# --- normalisation ----------------------------------------------------------------------------------------


def test_normalised_data_have_mean_zero_and_deviation_one() -> None:
    model = simple_model()
    obs, action, next_obs = random_transitions(model, 4, 500)
    obs, next_obs = obs * torch.tensor([1.0, 10.0, 0.01]) + 7, next_obs * torch.tensor([1.0, 10.0, 0.01]) + 7
    model.fit_normalisation(obs, next_obs)
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
    model.fit_normalisation(obs, next_obs)
    data = model.encode(obs + torch.tensor([0.0, 1.0, 0.0]), action, next_obs)
    assert data.x[..., 1].abs().max() < 2
    assert data.y[..., 1].abs().max() < 2
