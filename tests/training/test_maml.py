from __future__ import annotations

from dataclasses import replace
from itertools import islice

import pytest
import torch

from famle_agent.models.dynamics import Batch, Dynamics, Theta
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.members import with_members
from famle_agent.training.maml import MAML

INNER_LOOP = InnerLoop(steps=2, lr=0.1, embedding_lr=0.0)
SETTINGS = MAML(iterations=100, meta_lr=0.03, meta_batch_size=10, batch_size=5, query_size=10)


def situations(n: int, seed: int) -> Batch:
    """Functions y = a x + b + 2 sin(2 x) of one shape, 20 points each: (n, 20, 1)."""
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.randn(2, n, 1, 1, generator=generator)
    x = torch.randn(n, 20, 1, generator=generator)
    return Batch(x, a * x + b + 2 * torch.sin(2 * x), torch.ones(n, 20))


def fresh_model(n_situations: int = 1, members: int = 1) -> Dynamics:
    torch.manual_seed(0)
    return Dynamics(1, 0, n_situations, embedding_dim=2, hidden=(16,), gate_actions=False, members=members)


def meta_learn(maml: MAML, seed: int = 0) -> Dynamics:
    model = fresh_model()
    list(maml.steps(model, situations(40, seed=1), INNER_LOOP, torch.Generator().manual_seed(seed)))
    return model


def loss_after_adaptation(model: Dynamics, seed: int) -> float:
    data = situations(100, seed)
    support, query = (
        Batch(data.x[:, part], data.y[:, part], data.weight[:, part]) for part in (slice(5), slice(5, 20))
    )
    theta, h = model.theta_of(100), model.embeddings_of(torch.zeros(100, dtype=torch.long))
    theta, h, _ = INNER_LOOP(model, theta, h, lambda: support)
    return model.loss(query, h, theta).mean().item()


def difference(one: Theta, other: Theta) -> float:
    return max((one[name] - other[name]).abs().max().item() for name in one)


@pytest.mark.parametrize("first_order", [False, True])
def test_unseen_situations_are_fitted_better_after_meta_learning(first_order: bool) -> None:
    model = meta_learn(replace(SETTINGS, first_order=first_order))
    assert loss_after_adaptation(model, seed=2) < 0.8 * loss_after_adaptation(fresh_model(), seed=2)


def test_same_seed_same_parameters() -> None:
    one, same, other = (meta_learn(SETTINGS, seed).theta_of(1) for seed in (0, 0, 1))
    assert difference(one, same) == 0
    assert difference(one, other) > 1e-3


def test_order_of_the_gradient_matters() -> None:
    second, first = (meta_learn(replace(SETTINGS, first_order=flag)).theta_of(1) for flag in (False, True))
    assert difference(second, first) > 1e-3


def test_gradient_is_that_of_the_adapted_loss() -> None:
    """Against finite differences of the loss after the very same inner steps, along a random direction."""
    model, data = fresh_model().double(), situations(4, seed=3)
    support = Batch(*(value[:, :5].double() for value in (data.x, data.y, data.weight)))
    query = Batch(*(value[:, 5:].double() for value in (data.x, data.y, data.weight)))
    h = model.embeddings_of(torch.zeros(4, dtype=torch.long))

    def adapted_loss(maml: MAML, theta: Theta) -> torch.Tensor:
        of_situations = {name: value.expand(4, *value.shape) for name, value in theta.items()}
        theta_tilde, _ = maml.adapt(model, of_situations, h, support, INNER_LOOP)
        return model.loss(query, h, theta_tilde).mean()

    def slope(maml: MAML) -> float:
        gradients = torch.autograd.grad(adapted_loss(maml, dict(model.theta.items())), list(model.theta.values()))
        return sum(
            (gradient * direction[name]).sum().item() for name, gradient in zip(model.theta, gradients, strict=True)
        )

    direction = {name: torch.randn_like(value) for name, value in model.theta.items()}
    ahead, behind = (
        adapted_loss(SETTINGS, {name: value + step * direction[name] for name, value in model.theta.items()}).item()
        for step in (1e-5, -1e-5)
    )
    exact = (ahead - behind) / 2e-5
    assert slope(SETTINGS) == pytest.approx(exact, rel=1e-4)
    assert slope(replace(SETTINGS, first_order=True)) != pytest.approx(exact, rel=1e-2)


def test_inner_steps_and_their_judgement_see_different_transitions_of_the_same_situation() -> None:
    n, points = 6, 15
    serial = torch.arange(n * points, dtype=torch.float32).view(n, points, 1)
    data = Batch(serial, serial, torch.ones(n, points))
    c = torch.tensor([4, 1, 3])
    support, query = SETTINGS.sample(data, c, 2, torch.Generator().manual_seed(0))
    for row, situation in enumerate(c.tolist()):
        for member in range(2):
            seen = torch.cat([support.x[row, member], query.x[row, member]]).flatten()
            assert sorted(seen.tolist()) == serial[situation].flatten().tolist()


def test_embedding_stays_and_whoever_has_enough_stops() -> None:
    model = fresh_model()
    before = model.embeddings.detach().clone()
    learning = SETTINGS.steps(model, situations(4, seed=1), INNER_LOOP, torch.Generator().manual_seed(0))
    steps = list(islice(learning, 3))
    assert [step.iteration for step in steps] == [1, 2, 3]
    assert all(len(step.situations) == 4 for step in steps)  # fewer situations than the meta-batch asks for
    assert torch.equal(model.embeddings, before)


@pytest.mark.parametrize(
    ("inner_loop", "n_situations", "maml", "message"),
    [
        (INNER_LOOP, 2, SETTINGS, "n_situations=1"),
        (replace(INNER_LOOP, optimizer="adam"), 1, SETTINGS, 'optimizer="sgd"'),
        (replace(INNER_LOOP, embedding_lr=0.1), 1, SETTINGS, "embedding_lr=0"),
        (replace(INNER_LOOP, steps=0), 1, SETTINGS, "steps >= 1"),
        (INNER_LOOP, 1, replace(SETTINGS, query_size=16), "there are 20"),
    ],
)
def test_misuse_says_what_to_do(inner_loop: InnerLoop, n_situations: int, maml: MAML, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        next(maml.steps(fresh_model(n_situations), situations(4, seed=1), inner_loop, torch.Generator()))


# --- ensembles ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("first_order", [False, True])
def test_each_member_descends_the_gradient_that_it_would_have_alone(first_order: bool) -> None:
    """Of situations with one transition each, so that it does not matter which are drawn."""
    data = situations(4, seed=3)
    data = Batch(*(value[:, :1].expand_as(value).double() for value in (data.x, data.y, data.weight)))
    still = replace(SETTINGS, iterations=1, meta_lr=0.0, max_grad_norm=1e9, first_order=first_order)
    ensemble = fresh_model(members=3).double()
    for model in (ensemble, *(alone := [with_members(ensemble, 1, member) for member in range(3)])):
        list(still.steps(model, data, INNER_LOOP, torch.Generator()))
    for member in range(3):
        for name, value in ensemble.theta.items():
            torch.testing.assert_close(value.grad[member], alone[member].theta[name].grad[0])


def test_members_learn_as_independent_networks_do() -> None:
    """Whatever the others are: with the same minibatches, a member ends where it would have ended beside others."""
    few, data = replace(SETTINGS, iterations=5), situations(40, seed=1)
    ensembles = [fresh_model(members=3) for _ in range(2)]
    with torch.no_grad():
        for value in ensembles[1].theta.values():
            value[1].mul_(3.0)
    for model in ensembles:
        list(few.steps(model, data, INNER_LOOP, torch.Generator().manual_seed(0)))
    for name, value in ensembles[0].theta.items():
        torch.testing.assert_close(value[[0, 2]], ensembles[1].theta[name][[0, 2]])
        assert not torch.allclose(value[1], ensembles[1].theta[name][1])


def test_members_of_an_ensemble_are_as_good_as_one_network() -> None:
    """As many networks, from as many starting points and of as many minibatches."""
    before, model, data = fresh_model(members=3), fresh_model(members=3), situations(40, seed=1)
    list(SETTINGS.steps(model, data, INNER_LOOP, torch.Generator().manual_seed(0)))
    alone = loss_after_adaptation(meta_learn(SETTINGS), seed=2)
    for member in range(3):
        after, start = (loss_after_adaptation(with_members(one, 1, member), seed=2) for one in (model, before))
        assert after < 0.8 * start
        assert after < 1.3 * alone
    for name, value in model.theta.items():
        assert not torch.equal(value[0], value[1]), name


def test_gradient_of_each_member_is_shortened_by_itself() -> None:
    model = fresh_model(members=3)
    lengths = torch.tensor([0.5, 2.0, 30.0])
    count = sum(value[0].numel() for value in model.theta.values())
    for value in model.theta.values():
        value.grad = (lengths / count**0.5).view(-1, *[1] * (value.ndim - 1)).expand_as(value).clone()
    before = {name: value.grad.clone() for name, value in model.theta.items()}
    replace(SETTINGS, max_grad_norm=1.0).shorten_gradients(model)
    for member, factor in enumerate((1.0, 1 / 2, 1 / 30)):
        for name, value in model.theta.items():
            torch.testing.assert_close(value.grad[member], factor * before[name][member], rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("first_order", [False, True])
@pytest.mark.parametrize("members", [1, 2])
def test_divergence_says_what_to_do(first_order: bool, members: int) -> None:
    wild, maml = replace(INNER_LOOP, lr=1e6, steps=5), replace(SETTINGS, first_order=first_order)
    with pytest.raises(ValueError, match=r"diverged in iteration \d+; take a smaller inner_lr or meta_lr"):
        list(maml.steps(fresh_model(members=members), situations(4, seed=1), wild, torch.Generator().manual_seed(0)))
