from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent.adaptation.belief import prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.adaptation.posterior import systematic_sample
from famle_agent.adaptation.update import select
from tests.helpers import simple_model


def posteriors(weights: list[list[float]]) -> Tensor:
    p = torch.tensor(weights)
    return p / p.sum(dim=1, keepdim=True)


@given(
    st.lists(st.lists(st.floats(0.01, 1.0), min_size=5, max_size=5), min_size=1, max_size=3),
    st.integers(1, 6),
    st.floats(0.0, 0.999),
)
def test_sample_takes_each_candidate_by_its_probability(weights: list[list[float]], n: int, offset: float) -> None:
    p = posteriors(weights)
    taken = systematic_sample(p, n, offset)
    assert taken.shape == (len(p), n)
    for row, choice in zip(p, taken, strict=True):
        counts = torch.bincount(choice, minlength=5)
        assert ((counts - n * row).abs() < 1.0 + 1e-4).all()


def test_sample_without_offset_begins_with_the_most_likely() -> None:
    p = posteriors([[0.2, 0.5, 0.3], [0.4, 0.3, 0.3]])
    assert systematic_sample(p, 4, 0.0)[:, 0].tolist() == [1, 0]


def test_certain_posterior_leaves_one_candidate() -> None:
    assert systematic_sample(posteriors([[0.0, 0.0, 1.0], [1.0, 1e-9, 0.0]]), 4, 0.6).tolist() == [[2] * 4, [0] * 4]


def test_rows_do_not_depend_on_each_other() -> None:
    p = posteriors([[0.4, 0.3, 0.3], [0.1, 0.1, 0.8]])
    both, alone = systematic_sample(p, 4, 0.3), [systematic_sample(row[None], 4, 0.3) for row in p]
    assert torch.equal(both, torch.cat(alone))


def test_candidates_take_turns_from_one_adaptation_to_the_next() -> None:
    model = simple_model(n_situations=4)
    candidates = Candidates.of(model, compose=False)
    belief = replace(prior(model, candidates, robots=1), log_posterior=posteriors([[4, 3, 2, 1]]).log())
    starts = []
    for _ in range(40):
        belief = select(model, candidates, belief, spread=True)
        starts.append(int((model.embeddings[0] - belief.h[0]).norm(dim=1).argmin()))
    assert torch.bincount(torch.tensor(starts), minlength=4).tolist() == pytest.approx([16, 12, 8, 4], abs=2)


@pytest.mark.parametrize("spread", [False, True])
def test_members_start_from_situations_of_their_own_only_where_they_are_spread(spread: bool) -> None:
    model = simple_model(n_situations=4, members=4)
    candidates = Candidates.of(model, compose=False)
    belief = prior(model, candidates, robots=2)
    belief = replace(belief, log_posterior=posteriors([[1, 1, 1, 1], [0, 0, 9, 0]]).log())
    h = select(model, candidates, belief, spread=spread).h
    wanted = [0, 1, 2, 3] if spread else [0, 0, 0, 0]
    for member, situation in enumerate(wanted):
        torch.testing.assert_close(h[0, member], model.embeddings[member, situation])
        torch.testing.assert_close(h[1, member], model.embeddings[member, 2])
