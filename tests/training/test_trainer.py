from __future__ import annotations

from itertools import islice

import torch

from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.training.multitask import JointTraining
from famle_agent.training.reptile import Reptile
from famle_agent.training.trainer import MetaTrainer

JOINT, REPTILE = JointTraining(3, 0.01, 0.03, 16), Reptile(2, 0.5, 0.5, 2, 8)
INNER_LOOP = InnerLoop(2, 0.05, 0.2)


def fresh_model() -> Dynamics:
    torch.manual_seed(0)
    return Dynamics(1, 1, 4, embedding_dim=2, hidden=(8,))


def situations() -> Batch:
    """A motor of four gains: y = gain * a + x / 2."""
    x = torch.rand(4, 60, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1
    gain = torch.tensor([1.0, 0.0, -1.0, 0.5])[:, None, None]
    return Batch(x, gain * x[..., 1:] + 0.5 * x[..., :1], torch.ones(4, 60))


def test_trains_on_all_situations_and_then_meta_learns() -> None:
    one, other, generator = fresh_model(), fresh_model(), torch.Generator().manual_seed(3)
    metrics = list(MetaTrainer(JOINT, REPTILE, INNER_LOOP).fit(one, situations(), torch.Generator().manual_seed(3)))
    assert [set(row) for row in metrics] == [{"meta/joint_loss"}] * 3 + [{"meta/loss_before", "meta/loss_after"}] * 2
    list(JOINT.steps(other, situations(), generator))
    list(REPTILE.steps(other, situations(), INNER_LOOP, generator))
    other.fit_noise(situations())
    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


def test_noise_is_that_of_the_model_that_was_reached() -> None:
    model = fresh_model()
    training = MetaTrainer(JOINT, REPTILE, INNER_LOOP).fit(model, situations(), torch.Generator().manual_seed(3))
    assert len(list(islice(training, 2))) == 2
    training.close()  # type: ignore[attr-defined]
    noise = model.noise_std.clone()
    model.fit_noise(situations())
    assert torch.equal(model.noise_std, noise)
    assert not torch.equal(noise, fresh_model().noise_std)


def test_without_a_meta_learner_it_ends_with_the_joint_training() -> None:
    assert len(list(MetaTrainer(JOINT, None, INNER_LOOP).fit(fresh_model(), situations(), torch.Generator()))) == 3
