from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from famle_agent import AMPCMAML, NotLearnedError
from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.training.maml import MAML
from famle_agent.training.multitask import JointTraining
from famle_agent.training.reptile import MetaStep, Reptile

INNER_LOOP = InnerLoop(steps=4, lr=0.05, embedding_lr=0.2)


def fresh_model(members: int = 1, n_situations: int = 4) -> Dynamics:
    torch.manual_seed(0)
    return Dynamics(1, 1, n_situations, embedding_dim=2, hidden=(16,), members=members)


def situations() -> Batch:
    """A motor of four gains: y = gain * a + x / 2."""
    generator = torch.Generator().manual_seed(1)
    x = torch.rand(4, 60, 2, generator=generator) * 2 - 1
    gain = torch.tensor([1.0, 0.0, -1.0, 0.5])[:, None, None]
    return Batch(x, gain * x[..., 1:] + 0.5 * x[..., :1], torch.ones(4, 60))


def meta_learn(reptile: Reptile, seed: int = 0, members: int = 1) -> tuple[Dynamics, list[MetaStep]]:
    model = fresh_model(members)
    return model, list(reptile.steps(model, situations(), INNER_LOOP, torch.Generator().manual_seed(seed)))


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("meta_batch_size", [1, 2])
def test_one_iteration_is_algorithm_1(meta_batch_size: int, members: int) -> None:
    """theta += alpha_meta (theta~ - theta), h_c += beta_meta (h~ - h_c), and the other embeddings stay."""
    model, before, data = fresh_model(members), fresh_model(members), situations()
    reptile = Reptile(iterations=1, meta_lr=0.3, embedding_meta_lr=0.7, meta_batch_size=meta_batch_size, batch_size=8)
    steps = list(reptile.steps(model, data, INNER_LOOP, torch.Generator().manual_seed(5)))
    c = steps[0].situations

    generator = torch.Generator().manual_seed(5)
    assert torch.equal(c, torch.randperm(4, generator=generator)[:meta_batch_size])

    def sample() -> Batch:
        i = torch.randint(60, (len(c), members, 8), generator=generator)
        return data[c[:, None, None], i]

    theta, h = before.theta_of(meta_batch_size), before.embeddings[:, c].transpose(0, 1)
    theta_tilde, h_tilde, losses = INNER_LOOP(before, theta, h, sample)
    h_meta = h + 0.7 * (h_tilde - h)
    others = [i for i in range(4) if i not in c]
    for member in range(members):
        for name, value in model.theta.items():
            start, mean = before.theta[name][member], theta_tilde[name][:, member].mean(dim=0)
            torch.testing.assert_close(value[member], start + 0.3 * (mean - start))
        torch.testing.assert_close(model.embeddings[member, c], h_meta[:, member])
        assert torch.equal(model.embeddings[member, others], before.embeddings[member, others])
    assert steps[0].loss_before == losses[0].mean().item()
    assert steps[0].loss_after == losses[-1].mean().item()


def test_meta_learning_lowers_the_loss_of_every_situation() -> None:
    reptile = Reptile(iterations=300, meta_lr=1.0, embedding_meta_lr=1.0, meta_batch_size=4, batch_size=16)
    model, steps = meta_learn(reptile)
    assert [step.iteration for step in steps] == list(range(1, 301))
    assert steps[-1].loss_after < 0.1 * steps[0].loss_before
    c = torch.arange(4)
    own, others = (model.loss(situations(), model.embeddings_of(each)) for each in (c, c.roll(1)))
    assert (own < 0.5 * others).all()  # each embedding stands for its own situation


def test_situations_of_a_meta_batch_are_different() -> None:
    _, steps = meta_learn(Reptile(iterations=12, meta_lr=0.5, embedding_meta_lr=0.5, meta_batch_size=3, batch_size=8))
    drawn = [step.situations.tolist() for step in steps]
    assert all(len(set(c)) == 3 for c in drawn)
    assert set().union(*drawn) == {0, 1, 2, 3}


def test_meta_batch_may_be_larger_than_the_situations() -> None:
    _, steps = meta_learn(Reptile(iterations=2, meta_lr=0.5, embedding_meta_lr=0.5, meta_batch_size=99, batch_size=8))
    assert all(sorted(step.situations.tolist()) == [0, 1, 2, 3] for step in steps)


def test_steps_become_smaller() -> None:
    """The meta-rates decay linearly: the last of n iterations takes 1 / n of the first one's step."""
    reptile = Reptile(iterations=10, meta_lr=1.0, embedding_meta_lr=1.0, meta_batch_size=4, batch_size=60)
    model, no_learning = fresh_model(), InnerLoop(steps=1, lr=0.0, embedding_lr=1.0)
    learning = reptile.steps(model, situations(), no_learning, torch.Generator().manual_seed(0))
    embeddings = [model.embeddings.detach().clone() for _ in learning]
    first, last = (embeddings[0] - fresh_model().embeddings).norm(), (embeddings[-1] - embeddings[-2]).norm()
    assert last < 0.2 * first


def test_same_seed_same_model() -> None:
    reptile = Reptile(iterations=5, meta_lr=0.5, embedding_meta_lr=0.5, meta_batch_size=2, batch_size=8)
    (one, _), (same, _), (other, _) = (meta_learn(reptile, seed) for seed in (0, 0, 1))
    for name, value in one.state_dict().items():
        assert torch.equal(value, same.state_dict()[name])
    assert not torch.equal(one.embeddings, other.embeddings)


def test_members_of_an_ensemble_learn_by_themselves() -> None:
    """As many networks, from as many starting points and of as many minibatches."""
    reptile = Reptile(iterations=100, meta_lr=1.0, embedding_meta_lr=1.0, meta_batch_size=4, batch_size=16)
    model, steps = meta_learn(reptile, members=2)
    assert steps[-1].loss_after < 0.3 * steps[0].loss_before
    loss = model.loss(situations(), model.embeddings_of(torch.arange(4)))  # (N, P)
    assert loss.mean(dim=0).max() < 2 * loss.mean(dim=0).min()
    for value in (*model.theta.values(), model.embeddings):
        assert not torch.equal(value[0], value[1])


def test_data_of_another_number_of_situations_are_refused() -> None:
    reptile = Reptile(iterations=1, meta_lr=1.0, embedding_meta_lr=1.0, meta_batch_size=4, batch_size=16)
    model = Dynamics(1, 1, n_situations=3, embedding_dim=2, members=4)
    with pytest.raises(ValueError, match="3 embeddings, the data 4 situations"):
        next(reptile.steps(model, situations(), INNER_LOOP, torch.Generator()))


def test_whoever_has_enough_stops() -> None:
    model, steps = fresh_model(), []
    reptile = Reptile(iterations=50, meta_lr=0.5, embedding_meta_lr=0.5, meta_batch_size=2, batch_size=8)
    for step in reptile.steps(model, situations(), INNER_LOOP, torch.Generator().manual_seed(0)):
        steps.append(step.iteration)
        if step.iteration == 3:
            break
    assert steps == [1, 2, 3]


# --- one embedding for many situations ----------------------------------------------------------------------


THETA_ALONE = InnerLoop(steps=4, lr=0.05, embedding_lr=0.0)


def follow_reptile(model: Dynamics, data: Batch) -> None:
    learn = Reptile(iterations=60, meta_lr=1.0, embedding_meta_lr=1.0, meta_batch_size=2, batch_size=16)
    list(learn.steps(model, data, INNER_LOOP, torch.Generator().manual_seed(0)))


def follow_maml(model: Dynamics, data: Batch) -> None:
    learn = MAML(iterations=60, meta_lr=0.01, meta_batch_size=2, batch_size=16, query_size=16)
    list(learn.steps(model, data, THETA_ALONE, torch.Generator().manual_seed(0)))


def train_jointly(model: Dynamics, data: Batch) -> None:
    list(
        JointTraining(60, lr=0.01, embedding_lr=0.0, batch_size=32).steps(model, data, torch.Generator().manual_seed(0))
    )


every_learner = pytest.mark.parametrize("learn", [follow_reptile, follow_maml, train_jointly])


def losses(model: Dynamics, data: Batch) -> torch.Tensor:
    """The loss of each situation's data in each member, (N, P)."""
    return model.loss(data, model.embeddings_of(torch.arange(len(data.x))))


@every_learner
@pytest.mark.parametrize("members", [1, 2])
def test_one_embedding_stays_and_the_network_learns_all_situations(
    learn: Callable[[Dynamics, Batch], None], members: int
) -> None:
    model, before, data = fresh_model(members, 1), fresh_model(members, 1), situations()
    learn(model, data)
    assert torch.equal(model.embeddings, before.embeddings)
    assert (losses(model, data).mean(dim=0) < 0.8 * losses(before, data).mean(dim=0)).all()


def test_reptile_with_one_embedding_moves_towards_the_mean_of_the_adapted_networks() -> None:
    """Nichol et al., 2018: theta += alpha_meta mean(theta~ - theta)."""
    model, data = fresh_model(1, 1), situations()
    theta = {name: value.detach().clone() for name, value in model.theta.items()}
    alike = Batch(data.x[:, :1], data.y[:, :1], data.weight[:, :1])  # there is but one minibatch to draw
    adapted, _, _ = THETA_ALONE(model, model.theta_of(4), model.embeddings_of(torch.arange(4)), lambda: alike)
    list(Reptile(1, 0.3, 0.7, 4, batch_size=1).steps(model, alike, THETA_ALONE, torch.Generator()))
    for name, value in model.theta.items():
        torch.testing.assert_close(value, theta[name] + 0.3 * (adapted[name] - theta[name]).mean(dim=0))


@pytest.mark.parametrize("members", [1, 3])
def test_noise_of_one_embedding_is_that_of_all_situations(members: int) -> None:
    model, data = fresh_model(members, 1), situations()
    model.fit_noise(data)
    errors = model(data.x, model.embeddings_of(torch.arange(4))) - data.y[:, None]  # (N, P, n, obs_dim)
    variance = errors.square().mean(dim=(0, 2))
    torch.testing.assert_close(model.noise_std.square(), variance, rtol=1e-4, atol=1e-6)


def test_agent_whose_learning_failed_has_no_model(make_env: Callable[..., Any]) -> None:
    agent = AMPCMAML(make_env(), meta_learner="maml", device="cpu", transitions_per_situation=5, hidden=(4,))
    with pytest.raises(ValueError, match="different transitions of each situation"):
        agent.meta_learn(["intact"])
    with pytest.raises(NotLearnedError):
        agent.posterior()
