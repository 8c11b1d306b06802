from __future__ import annotations

from itertools import islice

import pytest
import torch

from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.training.multitask import JointTraining

TRAINING = JointTraining(iterations=400, lr=0.01, embedding_lr=0.03, batch_size=64)


def situations(n: int = 200) -> Batch:
    """A motor of four gains: y = gain * a + x / 2. Nothing but the gain tells the situations apart."""
    x = torch.rand(n, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1
    x = x.expand(4, n, 2)
    gain = torch.tensor([1.0, 0.0, -1.0, 0.5])[:, None, None]
    return Batch(x, gain * x[..., 1:] + 0.5 * x[..., :1], torch.ones(4, n))


def fresh_model(members: int = 1, gate_actions: bool = True) -> Dynamics:
    torch.manual_seed(0)
    return Dynamics(1, 1, n_situations=4, embedding_dim=2, hidden=(16,), members=members, gate_actions=gate_actions)


def trained(training: JointTraining = TRAINING, seed: int = 0, members: int = 1, gate: bool = True) -> Dynamics:
    model = fresh_model(members, gate)
    list(training.steps(model, situations(), torch.Generator().manual_seed(seed)))
    return model


def losses(model: Dynamics, c: list[int]) -> torch.Tensor:
    """The loss of each situation's data with the embedding of another, (N, P)."""
    return model.loss(situations(), model.embeddings_of(torch.tensor(c)))


@pytest.mark.parametrize("gate", [True, False])
@pytest.mark.parametrize("members", [1, 3])
def test_situations_that_differ_by_their_embedding_alone_are_told_apart(gate: bool, members: int) -> None:
    before, model = fresh_model(members, gate), trained(members=members, gate=gate)
    own = losses(model, [0, 1, 2, 3])
    assert (own.mean(dim=0) < 0.05 * losses(before, [0, 1, 2, 3]).mean(dim=0)).all()
    for others in ([1, 2, 3, 0], [2, 3, 0, 1], [3, 0, 1, 2]):
        assert (losses(model, others) > 3 * own).all()


def test_loss_falls() -> None:
    seen = list(TRAINING.steps(fresh_model(), situations(), torch.Generator().manual_seed(0)))
    assert len(seen) == 400
    assert sum(seen[-20:]) < 0.1 * sum(seen[:20])


def test_whoever_has_enough_stops() -> None:
    model, before = fresh_model(), fresh_model()
    training = TRAINING.steps(model, situations(), torch.Generator().manual_seed(0))
    assert len(list(islice(training, 3))) == 3
    training.close()  # type: ignore[attr-defined]
    assert not torch.equal(model.embeddings, before.embeddings)


def test_no_iterations_change_nothing() -> None:
    model, before = fresh_model(), fresh_model()
    none = JointTraining(iterations=0, lr=0.1, embedding_lr=0.1, batch_size=8)
    assert list(none.steps(model, situations(), torch.Generator())) == []
    for name, value in model.state_dict().items():
        assert torch.equal(value, before.state_dict()[name])


def test_same_seed_same_model() -> None:
    few = JointTraining(iterations=5, lr=0.01, embedding_lr=0.03, batch_size=8)
    one, same, other = (trained(few, seed) for seed in (0, 0, 1))
    for name, value in one.state_dict().items():
        assert torch.equal(value, same.state_dict()[name])
    assert not torch.equal(one.embeddings, other.embeddings)


def test_all_chance_comes_from_the_generator() -> None:
    model, state = fresh_model(), torch.get_rng_state()
    few = JointTraining(iterations=2, lr=0.01, embedding_lr=0.03, batch_size=8)
    list(few.steps(model, situations(), torch.Generator().manual_seed(0)))
    assert torch.equal(torch.get_rng_state(), state)


def test_network_and_embeddings_have_rates_of_their_own() -> None:
    before = fresh_model()
    for lr, embedding_lr in ((0.0, 0.1), (0.1, 0.0)):
        model = trained(JointTraining(iterations=2, lr=lr, embedding_lr=embedding_lr, batch_size=64))
        assert torch.equal(model.embeddings, before.embeddings) == (embedding_lr == 0)
        for name, value in model.theta.items():
            assert torch.equal(value, before.theta[name]) == (lr == 0), name


def test_steps_become_smaller_in_the_second_half() -> None:
    """Of a loss that falls for ever, Adam's steps are as long as its rate says."""
    training, model = JointTraining(iterations=20, lr=0.0, embedding_lr=0.01, batch_size=400), fresh_model()
    places = [model.embeddings.detach().clone()]
    for _ in training.steps(model, situations(), torch.Generator().manual_seed(0)):
        places.append(model.embeddings.detach().clone())
    lengths = torch.stack(places).diff(dim=0).abs().amax(dim=(1, 2, 3))
    torch.testing.assert_close(lengths[:3], torch.full((3,), 0.01), rtol=0.2, atol=0.0)
    assert lengths[-1] < 0.25 * lengths[0]


def test_minibatch_is_drawn_from_all_situations_and_differs_between_members() -> None:
    serial = torch.arange(4 * 50, dtype=torch.float32).view(4, 50, 1)
    data = Batch(serial, -serial, torch.ones(4, 50))
    c, batch = TRAINING.sample(data, 3, torch.Generator().manual_seed(0))
    assert c.shape == (1, 3, 64)
    assert set(c.flatten().tolist()) == {0, 1, 2, 3}
    assert torch.equal(batch.x[..., 0] // 50, c.float())  # the transitions are of these situations
    assert torch.equal(batch.y, -batch.x)
    assert len({tuple(row) for row in batch.x[0, ..., 0].tolist()}) == 3


def test_members_that_begin_alike_part_ways() -> None:
    model = fresh_model(members=2)
    with torch.no_grad():
        for value in (*model.theta.values(), model.embeddings):
            value[1] = value[0]
    next(iter(TRAINING.steps(model, situations(), torch.Generator().manual_seed(0))))
    assert not torch.equal(model.embeddings[0], model.embeddings[1])
    assert not torch.equal(model.theta["weight_0"][0], model.theta["weight_0"][1])
