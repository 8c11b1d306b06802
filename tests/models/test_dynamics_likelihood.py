from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.members import with_members
from tests.helpers import log_likelihood, models, random_h, random_theta, random_transitions, simple_model

every_likelihood = pytest.mark.parametrize("degrees_of_freedom", [0.0, 3.0])


def training_batch(model: Dynamics, n: int) -> Batch:
    return model.encode(*random_transitions(model, model.n_situations, n))


def log_likelihood_per_member(model: Dynamics, data: Batch) -> Tensor:
    """Of all transitions together, (P,)."""
    alone = [with_members(model, 1, member) for member in range(model.members)]
    c = torch.arange(model.n_situations)
    return torch.stack([log_likelihood(one, data, one.embeddings_of(c)).sum() for one in alone])


def exact_batch(model: Dynamics, n: int) -> Batch:
    """Targets that the model, of one member, predicts without an error."""
    x, N = torch.randn(model.n_situations, n, model.n_features + model.action_dim), model.n_situations
    y = model(x, model.embeddings_of(torch.arange(N)), model.theta_of(N))[:, 0]
    return Batch(x, y, torch.ones(N, n))


# --- the loss ---------------------------------------------------------------------------------------------


def test_loss_is_half_the_mean_squared_error() -> None:
    model = simple_model()
    h, data = model.embeddings_of(torch.tensor([0])), model.encode(*random_transitions(model, 1, 9))
    error = model(data.x, h)[:, 0] - data.y
    torch.testing.assert_close(model.loss(data, h), 0.5 * error.square().mean()[None, None])


def test_loss_with_an_embedding_for_each_transition() -> None:
    model = simple_model(members=2)
    data, h = model.encode(*random_transitions(model, 1, 8)), model.embeddings_by_row(torch.randint(4, (1, 2, 8)))
    each = [
        model.loss(Batch(data.x[:, i : i + 1], data.y[:, i : i + 1], data.weight[:, i : i + 1]), h[:, :, i])
        for i in range(8)
    ]
    torch.testing.assert_close(model.loss(data, h), torch.stack(each).mean(dim=0))


@given(models(), st.integers(1, 5), st.integers(1, 5))
def test_padding_changes_nothing(model: Dynamics, n: int, padding: int) -> None:
    theta, h = random_theta(model, 2), random_h(model, 2)
    real, noise = random_transitions(model, 2, n), random_transitions(model, 2, padding)
    weight = torch.cat([torch.ones(2, n), torch.zeros(2, padding)], dim=1)
    padded = model.encode(*(torch.cat([a, b], dim=1) for a, b in zip(real, noise, strict=True)), weight)
    data = model.encode(*real)
    torch.testing.assert_close(model.loss(padded, h, theta), model.loss(data, h, theta))


def test_nothing_but_padding_has_no_loss() -> None:
    model = simple_model()
    data = model.encode(*random_transitions(model, 1, 3), torch.zeros(1, 3))
    assert model.loss(data, model.embeddings_of(torch.tensor([0]))).item() == 0


# --- the likelihood ---------------------------------------------------------------------------------------


@given(models(), st.integers(1, 4))
def test_log_likelihood_is_that_of_its_distribution(model: Dynamics, n: int) -> None:
    """A mean over the members of each one's, with the noise of each."""
    theta, h = random_theta(model, 2), random_h(model, 2)
    data = model.encode(*random_transitions(model, 2, n))
    mean, noise = model(data.x, h, theta), model.noise_std[:, None]
    nu = model.degrees_of_freedom
    shape = torch.distributions.StudentT(nu, mean, noise) if nu else torch.distributions.Normal(mean, noise)
    expected = shape.log_prob(data.y[:, None]).sum(dim=-1).mean(dim=1)
    torch.testing.assert_close(log_likelihood(model, data, h, theta), expected, rtol=1e-4, atol=1e-3)


def densities_of(model: Dynamics, y: Tensor) -> Tensor:
    """Log-density at targets of one dimension."""
    x = torch.zeros(1, len(y), model.n_features + model.action_dim, dtype=y.dtype)
    data = Batch(x, y[None, :, None], torch.ones(1, len(y), dtype=y.dtype))
    return log_likelihood(model, data, model.embeddings_of(torch.tensor([0])), model.theta_of(1))[0]


@pytest.mark.parametrize("degrees_of_freedom", [0.0, 0.7, 2.0, 3.0, 30.0])
def test_density_integrates_to_one(degrees_of_freedom: float) -> None:
    model = simple_model(obs_dim=1, degrees_of_freedom=degrees_of_freedom).double()
    model.noise_std.fill_(0.4)
    u = torch.linspace(-40.0, 40.0, 40_001, dtype=torch.float64)
    y = u.sinh()  # dense in the middle, and out to where the heavy tails end
    density = densities_of(model, y).exp() * u.cosh()
    assert torch.trapezoid(density, u).item() == pytest.approx(1.0, abs=1e-6)


def test_student_t_becomes_gaussian_with_its_degrees_of_freedom() -> None:
    y = torch.linspace(-4.0, 4.0, 41, dtype=torch.float64)
    gaussian, *others = (
        densities_of(simple_model(obs_dim=1, degrees_of_freedom=nu).double(), y) for nu in (0.0, 3.0, 30.0, 1e6)
    )
    errors = [(other - gaussian).abs().max().item() for other in others]
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 1.0
    assert errors[-1] < 1e-3


def test_student_t_forgives_what_no_model_predicts() -> None:
    gaussian, student = (simple_model(obs_dim=1, degrees_of_freedom=nu) for nu in (0.0, 3.0))
    usual, wild = torch.tensor([1.0]), torch.tensor([40.0])
    fall = [(densities_of(model, usual) - densities_of(model, wild)).item() for model in (gaussian, student)]
    assert fall[0] > 500
    assert fall[1] < 20


# --- the noise --------------------------------------------------------------------------------------------


@every_likelihood
@pytest.mark.parametrize("members", [1, 2])
def test_fitted_noise_is_the_most_likely(degrees_of_freedom: float, members: int) -> None:
    model = simple_model(degrees_of_freedom=degrees_of_freedom, members=members)
    data = training_batch(model, 200)
    model.fit_noise(data)
    best, fitted = log_likelihood_per_member(model, data), model.noise_std.clone()
    assert fitted.shape == (members, 3)
    for factor in (0.9, 1.1):
        model.noise_std.copy_(factor * fitted)
        assert (log_likelihood_per_member(model, data) < best).all()


@every_likelihood
def test_fitted_noise_is_the_scale_of_the_residuals(degrees_of_freedom: float) -> None:
    model, scale = simple_model(degrees_of_freedom=degrees_of_freedom), torch.tensor([0.05, 0.4, 2.0])
    torch.manual_seed(1)
    data = exact_batch(model, 4000)
    shape = torch.distributions.StudentT(3.0) if degrees_of_freedom else torch.distributions.Normal(0.0, 1.0)
    model.fit_noise(Batch(data.x, data.y + scale * shape.sample(data.y.shape), data.weight))
    torch.testing.assert_close(model.noise_std[0], scale, rtol=0.05, atol=0.0)


def test_heavy_tails_hardly_move_the_noise_of_a_student_t() -> None:
    fitted = []
    for degrees_of_freedom in (0.0, 3.0):
        model = simple_model(degrees_of_freedom=degrees_of_freedom)
        torch.manual_seed(1)
        data = exact_batch(model, 1000)
        y = data.y + 0.1 * torch.randn_like(data.y)
        y[:, ::50] += 5.0
        model.fit_noise(Batch(data.x, y, data.weight))
        fitted.append(model.noise_std.max().item())
    assert fitted[0] > 0.5
    assert fitted[1] < 0.15


@every_likelihood
def test_padding_does_not_count_in_the_noise(degrees_of_freedom: float) -> None:
    model = simple_model(degrees_of_freedom=degrees_of_freedom)
    data, noise = training_batch(model, 50), 100 * torch.randn(4, 30, 3)
    model.fit_noise(data)
    expected = model.noise_std.clone()
    x, y = torch.cat([data.x, torch.randn(4, 30, 5)], dim=1), torch.cat([data.y, noise], dim=1)
    model.fit_noise(Batch(x, y, torch.cat([data.weight, torch.zeros(4, 30)], dim=1)))
    torch.testing.assert_close(model.noise_std, expected)


@every_likelihood
def test_fitted_noise_of_an_exact_model_is_above_zero(degrees_of_freedom: float) -> None:
    model = simple_model(degrees_of_freedom=degrees_of_freedom)
    data = exact_batch(model, 20)
    model.fit_noise(data)
    assert (model.noise_std > 0).all()
    assert log_likelihood_per_member(model, data).isfinite().all()


def test_noise_of_very_many_transitions_is_that_of_all_situations() -> None:
    """More transitions than it is fitted to: a part of each situation's."""
    model = simple_model(obs_dim=1, hidden=(2,))
    torch.manual_seed(1)
    data = exact_batch(model, 30_000)
    scale = torch.tensor([0.1, 0.2, 0.4, 0.8])[:, None, None]
    model.fit_noise(Batch(data.x, data.y + scale * torch.randn_like(data.y), data.weight))
    assert model.noise_std.item() == pytest.approx(math.sqrt(scale.square().mean().item()), rel=0.05)
