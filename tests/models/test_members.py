from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from famle_agent.adaptation.belief import prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.posterior import window_posterior
from famle_agent.adaptation.update import descend, select
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.members import for_robots, with_members
from tests.helpers import memory_of, models, random_h, random_transitions, simple_model

INNER_LOOP = InnerLoop(steps=2, lr=1e-2, embedding_lr=1e-1)


@given(models(), st.integers(1, 4), st.booleans(), st.data())
def test_robots_with_own_networks_adapt_as_they_would_alone(
    model: Dynamics, n: int, compose: bool, data: st.DataObject
) -> None:
    chosen = data.draw(st.lists(st.integers(0, model.members - 1), min_size=2, max_size=3))
    together = for_robots(model, chosen)
    assert (together.robots, together.members) == (len(chosen), 1)
    transitions = random_transitions(model, len(chosen), n)
    candidates = Candidates.of(together, compose)
    memory = memory_of(together, candidates, *transitions)
    start = replace(prior(together, candidates, len(chosen)), log_posterior=window_posterior(candidates, memory))
    fleet = descend(together, select(together, candidates, start), memory, INNER_LOOP)
    for i, member in enumerate(chosen):
        own = with_members(model, 1, first=member)
        candidates = Candidates.of(own, compose)
        memory = memory_of(own, candidates, *(values[i : i + 1] for values in transitions))
        start = replace(prior(own, candidates, 1), log_posterior=window_posterior(candidates, memory))
        alone = descend(own, select(own, candidates, start), memory, INNER_LOOP)
        torch.testing.assert_close(fleet.log_posterior[i], alone.log_posterior[0], rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(fleet.h[i], alone.h[0], rtol=1e-3, atol=1e-4)
        for name, value in alone.theta.items():
            torch.testing.assert_close(fleet.theta[name][i], value[0], rtol=1e-3, atol=1e-4)


def test_model_of_some_robots_is_of_no_other_number() -> None:
    model = for_robots(simple_model(members=3), [0, 2])
    with pytest.raises(ValueError, match="networks for 2 robots, not for 3"):
        model.theta_of(3)
    with pytest.raises(ValueError, match="has no members to give"):
        with_members(model, 1)


@pytest.mark.parametrize("networks", [[0, 3], [-1]])
def test_network_that_does_not_exist_is_refused(networks: list[int]) -> None:
    with pytest.raises(ValueError, match="members 0 to 2 to give"):
        for_robots(simple_model(members=3), networks)


@given(models(), st.data())
def test_part_of_an_ensemble_is_some_of_its_members(model: Dynamics, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, model.members))
    first = data.draw(st.integers(0, model.members - count))
    part, chosen = with_members(model, count, first), slice(first, first + count)
    assert part.members == count
    h, batch = random_h(model, 2), model.encode(*random_transitions(model, 2, 4))
    torch.testing.assert_close(part.loss(batch, h[:, chosen]), model.loss(batch, h)[:, chosen])
    assert torch.equal(part.embeddings, model.embeddings[chosen])
    assert torch.equal(part.noise_std, model.noise_std[chosen])
    with torch.no_grad():
        part.embeddings.add_(1.0)
    assert not torch.equal(part.embeddings, model.embeddings[chosen])
    for wrong, start in ((0, 0), (model.members + 1, 0), (1, model.members), (1, -1), (model.members, 1)):
        with pytest.raises(ValueError, match=f"1 to {model.members} members to give, not {wrong} from {start} on"):
            with_members(model, wrong, start)
