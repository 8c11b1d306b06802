from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from famle_agent.adaptation.belief import prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.posterior import window_posterior
from famle_agent.adaptation.update import adapt
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from tests.helpers import memory_of, models, random_transitions, simple_model

INNER_LOOP = InnerLoop(steps=2, lr=1e-2, embedding_lr=1e-1)


@given(models(), st.integers(1, 4), st.booleans(), st.data())
def test_robots_with_own_networks_adapt_as_they_would_alone(
    model: Dynamics, n: int, compose: bool, data: st.DataObject
) -> None:
    chosen = data.draw(st.lists(st.integers(0, model.members - 1), min_size=2, max_size=3))
    together = model.for_robots(chosen)
    assert (together.robots, together.members) == (len(chosen), 1)
    transitions = random_transitions(model, len(chosen), n)
    candidates = Candidates.of(together, compose)
    memory = memory_of(together, candidates, *transitions)
    start = replace(prior(together, candidates, len(chosen)), log_posterior=window_posterior(candidates, memory))
    fleet = adapt(together, candidates, memory, INNER_LOOP, start)
    for i, member in enumerate(chosen):
        own = model.with_members(1, first=member)
        candidates = Candidates.of(own, compose)
        memory = memory_of(own, candidates, *(values[i : i + 1] for values in transitions))
        start = replace(prior(own, candidates, 1), log_posterior=window_posterior(candidates, memory))
        alone = adapt(own, candidates, memory, INNER_LOOP, start)
        torch.testing.assert_close(fleet.log_posterior[i], alone.log_posterior[0], rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(fleet.h[i], alone.h[0], rtol=1e-3, atol=1e-4)
        for name, value in alone.theta.items():
            torch.testing.assert_close(fleet.theta[name][i], value[0], rtol=1e-3, atol=1e-4)


def test_model_of_some_robots_is_of_no_other_number() -> None:
    model = simple_model(members=3).for_robots([0, 2])
    with pytest.raises(ValueError, match="networks for 2 robots, not for 3"):
        model.theta_of(3)
    with pytest.raises(ValueError, match="has no members to give"):
        model.with_members(1)


@pytest.mark.parametrize("networks", [[0, 3], [-1]])
def test_network_that_does_not_exist_is_refused(networks: list[int]) -> None:
    with pytest.raises(ValueError, match="members 0 to 2 to give"):
        simple_model(members=3).for_robots(networks)
