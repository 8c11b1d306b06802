"""Gradient steps that have to prove themselves on the newest transitions."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from famle_agent.adaptation.belief import prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.update import descend, select
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from tests.helpers import memory_of, random_transitions, simple_model

STEPS = InnerLoop(steps=20, lr=1e-2, embedding_lr=1e-2, optimizer="adam")


def remembered(model: Dynamics, candidates: Candidates, shift: Tensor) -> Memory:
    """30 transitions of one robot whose state also moves by ``shift`` (30,) in each."""
    torch.manual_seed(3)
    obs, action, _ = random_transitions(model, 1, len(shift))
    return memory_of(model, candidates, obs, action, obs + shift[None, :, None])


def moved(model: Dynamics, memory: Memory, validation_size: int) -> bool:
    """Whether adapting changed the model."""
    candidates = Candidates.of(model, compose=False)
    start = prior(model, candidates, 1)
    belief = descend(model, select(model, candidates, start), memory, STEPS, validation_size)
    changes = {name: not torch.equal(value, start.theta[name]) for name, value in belief.theta.items()}
    assert len(set(changes.values())) == 1
    return changes["weight_0"]


@pytest.mark.parametrize("members", [1, 3])
def test_steps_that_help_on_new_transitions_are_kept(members: int) -> None:
    model = simple_model(members=members)
    memory = remembered(model, Candidates.of(model, compose=False), torch.full((30,), 3.0))
    assert moved(model, memory, validation_size=10)


def test_steps_that_hurt_on_new_transitions_are_taken_back() -> None:
    model = simple_model()
    shift = torch.where(torch.arange(30) < 20, 3.0, -3.0)
    memory = remembered(model, Candidates.of(model, compose=False), shift)
    assert not moved(model, memory, validation_size=10)
    assert moved(model, memory, validation_size=0)


def test_each_member_is_judged_by_itself() -> None:
    model = simple_model(members=2)
    with torch.no_grad():  # the second member knows already what the first has to learn
        model.theta["weight_2"][1], model.theta["bias_2"][1] = 0.0, 3.0
    candidates = Candidates.of(model, compose=False)
    memory = remembered(model, candidates, torch.full((30,), 3.0))
    start = prior(model, candidates, 1)
    belief = descend(model, select(model, candidates, start), memory, STEPS, validation_size=10)
    same = [torch.equal(belief.theta["bias_2"][0, p], start.theta["bias_2"][0, p]) for p in range(2)]
    assert same == [False, True]


def test_steps_do_not_see_the_transitions_that_judge_them() -> None:
    model = simple_model()
    candidates = Candidates.of(model, compose=False)
    memory = remembered(model, candidates, torch.full((30,), 3.0))
    other = memory.next_obs.clone()
    other[:, -10:] += 0.1
    one, two = (
        descend(model, select(model, candidates, prior(model, candidates, 1)), m, STEPS, validation_size=10)
        for m in (memory, replace(memory, next_obs=other))
    )
    assert torch.equal(one.h, two.h)
