from __future__ import annotations

import pytest
import torch

from famle_agent.dynamics import Batch, Dynamics, expand
from famle_agent.inner_loop import InnerLoop
from famle_agent.meta_learning import MetaStep, Reptile

INNER_LOOP = InnerLoop(steps=4, lr=0.05, embedding_lr=0.2)


def fresh_model(members: int = 1) -> Dynamics:
    torch.manual_seed(0)
    return Dynamics(1, 1, n_situations=4, embedding_dim=2, hidden=(16,), members=members)


def situations() -> Batch:
    """A motor of four gains: y = gain * a + x / 2."""
    generator = torch.Generator().manual_seed(1)
    x = torch.rand(4, 60, 2, generator=generator) * 2 - 1
    gain = torch.tensor([1.0, 0.0, -1.0, 0.5])[:, None, None]
    return Batch(x, gain * x[..., 1:] + 0.5 * x[..., :1], torch.ones(4, 60))


def meta_learn(reptile: Reptile, seed: int = 0, members: int = 1) -> tuple[Dynamics, list[MetaStep]]:
    model, steps = fresh_model(members), []
    reptile(model, situations(), INNER_LOOP, torch.Generator().manual_seed(seed), lambda s: steps.append(s) or True)
    return model, steps


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("meta_batch_size", [1, 2])
def test_one_iteration_is_algorithm_1(meta_batch_size: int, members: int) -> None:
    """theta += alpha_meta (theta~ - theta), h_c += beta_meta (h~ - h_c), and the other embeddings stay."""
    model, before, data = fresh_model(members), fresh_model(members), situations()
    reptile = Reptile(iterations=1, meta_lr=0.3, embedding_meta_lr=0.7, meta_batch_size=meta_batch_size, batch_size=8)
    steps: list[MetaStep] = []
    reptile(model, data, INNER_LOOP, torch.Generator().manual_seed(5), lambda s: steps.append(s) or True)
    c = steps[0].situations

    generator = torch.Generator().manual_seed(5)
    assert torch.equal(c, torch.randperm(4, generator=generator)[:meta_batch_size])

    rows = c.repeat_interleave(members)

    def sample() -> Batch:
        i = torch.randint(60, (len(rows), 8), generator=generator)
        return Batch(*(values[rows[:, None], i] for values in (data.x, data.y, data.weight)))

    theta = before.parameters_by_name()
    h = torch.stack([before.embeddings[member, situation] for situation in c for member in range(members)])
    theta_tilde, h_tilde, losses = INNER_LOOP(before, expand(theta, meta_batch_size), h, sample)
    h_meta = h + 0.7 * (h_tilde - h)
    others = [i for i in range(4) if i not in c]
    for member in range(members):
        own = slice(member, None, members)  # the rows of this member
        for name, value in model.parameters_by_name().items():
            mean = theta_tilde[name][own].mean(dim=0)
            torch.testing.assert_close(value[member], theta[name][member] + 0.3 * (mean - theta[name][member]))
        torch.testing.assert_close(model.embeddings[member, c], h_meta[own])
        assert torch.equal(model.embeddings[member, others], before.embeddings[member, others])
    assert steps[0].loss_before == losses[0].mean().item()
    assert steps[0].loss_after == losses[-1].mean().item()


def test_meta_learning_lowers_the_loss_of_every_situation() -> None:
    reptile = Reptile(iterations=300, meta_lr=1.0, embedding_meta_lr=1.0, meta_batch_size=4, batch_size=16)
    model, steps = meta_learn(reptile)
    assert [step.iteration for step in steps] == list(range(1, 301))
    assert steps[-1].loss_after < 0.1 * steps[0].loss_before
    theta, c = expand(model.parameters_by_name(), 4), torch.arange(4)
    own = model.loss(theta, model.embeddings_of(c), situations())
    others = model.loss(theta, model.embeddings_of(c.roll(1)), situations())
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
    model, embeddings = fresh_model(), []

    def callback(step: MetaStep) -> bool:
        embeddings.append(model.embeddings.detach().clone())
        return True

    no_learning = InnerLoop(steps=1, lr=0.0, embedding_lr=1.0)
    reptile(model, situations(), no_learning, torch.Generator().manual_seed(0), callback)
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
    data, c = situations(), torch.arange(4)
    both = Batch(*(values.repeat_interleave(2, dim=0) for values in (data.x, data.y, data.weight)))
    loss = model.loss(expand(model.parameters_by_name(), 4), model.embeddings_of(c), both).view(4, 2)
    assert loss.mean(dim=0).max() < 2 * loss.mean(dim=0).min()
    for value in (*model.theta.values(), model.embeddings):
        assert not torch.equal(value[0], value[1])


def test_data_of_another_number_of_situations_are_refused() -> None:
    reptile = Reptile(iterations=1, meta_lr=1.0, embedding_meta_lr=1.0, meta_batch_size=4, batch_size=16)
    model = Dynamics(1, 1, n_situations=3, embedding_dim=2, members=4)
    with pytest.raises(ValueError, match="3 embeddings, the data 4 situations"):
        reptile(model, situations(), INNER_LOOP, torch.Generator())


def test_callback_ends_it() -> None:
    model, steps = fresh_model(), []

    def callback(step: MetaStep) -> bool:
        steps.append(step.iteration)
        return step.iteration < 3

    reptile = Reptile(iterations=50, meta_lr=0.5, embedding_meta_lr=0.5, meta_batch_size=2, batch_size=8)
    reptile(model, situations(), INNER_LOOP, torch.Generator().manual_seed(0), callback)
    assert steps == [1, 2, 3]
