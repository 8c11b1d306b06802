from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from famle_agent.models.dynamics import Batch, Dynamics, Theta
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.members import with_members

OPTIMIZERS = ("sgd", "adam")


def fresh_model() -> Dynamics:
    torch.manual_seed(0)
    return Dynamics(2, 1, n_situations=3, embedding_dim=2, hidden=(6,))


def some_data(size: int, seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)
    x, y = torch.randn(size, 8, 3, generator=generator), torch.randn(size, 8, 2, generator=generator)
    return Batch(x, y, torch.ones(size, 8))


def start(model: Dynamics, size: int) -> tuple[Theta, torch.Tensor]:
    return model.theta_of(size), model.embeddings_of(torch.arange(size))


@given(st.integers(0, 4), st.floats(0.0, 0.1), st.floats(0.0, 0.5))
def test_steps_are_those_of_gradient_descent(steps: int, lr: float, embedding_lr: float) -> None:
    model, data = fresh_model(), some_data(1)
    theta, h, losses = InnerLoop(steps, lr, embedding_lr)(model, *start(model, 1), lambda: data)

    theta_hand, h_hand = start(model, 1)
    for step in range(steps):
        leaves = {name: value.clone().requires_grad_() for name, value in theta_hand.items()}
        h_leaf = h_hand.clone().requires_grad_()
        error = model(data.x, h_leaf, leaves)[:, 0] - data.y
        loss = 0.5 * error.square().mean()
        gradients = torch.autograd.grad(loss, [*leaves.values(), h_leaf])
        theta_hand = {
            name: value - lr * gradient for (name, value), gradient in zip(theta_hand.items(), gradients, strict=False)
        }
        h_hand = h_hand - embedding_lr * gradients[-1]
        torch.testing.assert_close(losses[step, 0, 0], loss.detach())
    assert losses.shape == (steps, 1, 1)
    torch.testing.assert_close(h, h_hand)
    for name, value in theta_hand.items():
        torch.testing.assert_close(theta[name], value)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_situations_do_not_influence_each_other(optimizer: str) -> None:
    model, data = fresh_model(), some_data(3)
    loop = InnerLoop(5, 0.05, 0.2, optimizer)
    theta, h, losses = loop(model, *start(model, 3), lambda: data)
    for i in range(3):
        row = slice(i, i + 1)
        alone = Batch(data.x[row], data.y[row], data.weight[row])
        one, h_one, loss = loop(model, model.theta_of(1), model.embeddings_of(torch.tensor([i])), lambda b=alone: b)
        torch.testing.assert_close(h[row], h_one)
        torch.testing.assert_close(losses[:, row], loss)
        for name, value in one.items():
            torch.testing.assert_close(theta[name][row], value)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_network_and_embedding_have_rates_of_their_own(optimizer: str) -> None:
    model, data = fresh_model(), some_data(2)
    theta, h = start(model, 2)
    for lr, embedding_lr in ((0.0, 0.1), (0.1, 0.0)):
        theta_tilde, h_tilde, _ = InnerLoop(3, lr, embedding_lr, optimizer)(model, theta, h, lambda: data)
        assert torch.equal(h_tilde, h) == (embedding_lr == 0)
        for name, value in theta.items():
            assert torch.equal(theta_tilde[name], value) == (lr == 0), name


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_start_is_not_changed(optimizer: str) -> None:
    model, data = fresh_model(), some_data(2)
    theta, h = start(model, 2)
    before, h_before = {name: value.clone() for name, value in theta.items()}, h.clone()
    theta_tilde, h_tilde, _ = InnerLoop(2, 0.1, 0.1, optimizer)(model, theta, h, lambda: data)
    assert torch.equal(h, h_before)
    assert all(torch.equal(value, before[name]) for name, value in theta.items())
    assert all(value.grad is None for value in model.parameters())
    assert not h_tilde.requires_grad
    assert not any(value.requires_grad for value in theta_tilde.values())


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_many_steps_lower_the_loss(optimizer: str) -> None:
    model, data = fresh_model(), some_data(3)
    _, _, losses = InnerLoop(100, 0.05, 0.1, optimizer)(model, *start(model, 3), lambda: data)
    assert (losses[-1] < 0.9 * losses[0]).all()


def test_each_step_draws_its_data() -> None:
    model, drawn = fresh_model(), []

    def sample() -> Batch:
        drawn.append(some_data(1, seed=len(drawn)))
        return drawn[-1]

    theta, h = start(model, 1)
    _, _, losses = InnerLoop(3, 0.0, 0.0)(model, theta, h, sample)
    assert len(drawn) == 3
    for loss, data in zip(losses, drawn, strict=True):
        torch.testing.assert_close(loss, model.loss(data, h, theta))


def test_gradients_are_found_where_they_are_switched_off() -> None:
    model, data = fresh_model(), some_data(1)
    with torch.no_grad():
        theta, *_ = InnerLoop(1, 0.1, 0.1)(model, *start(model, 1), lambda: data)
    assert not torch.equal(theta["weight_0"], start(model, 1)[0]["weight_0"])


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_members_of_an_ensemble_do_not_influence_each_other(optimizer: str) -> None:
    torch.manual_seed(0)
    model = Dynamics(2, 1, n_situations=3, embedding_dim=2, hidden=(6,), members=2)
    data = Batch(*(values.unflatten(0, (3, 2)) for values in vars(some_data(6)).values()))  # each its own
    loop, h = InnerLoop(5, 0.05, 0.2, optimizer), model.embeddings_of(torch.arange(3))
    theta, h_tilde, losses = loop(model, model.theta_of(3), h, lambda: data)
    for member in range(2):
        alone = with_members(model, 1, member)
        batch = Batch(*(values[:, member] for values in vars(data).values()))
        one, h_one, loss = loop(alone, alone.theta_of(3), h[:, [member]], lambda b=batch: b)
        torch.testing.assert_close(h_tilde[:, [member]], h_one)
        torch.testing.assert_close(losses[..., [member]], loss)
        for name, value in one.items():
            torch.testing.assert_close(theta[name][:, [member]], value)
