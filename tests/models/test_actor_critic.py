"""Actor and critics that see products of the observation and the situation."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from famle_agent.models.actor_critic import ActorCritic, Features


@given(seed=st.integers(0, 1000), obs_dim=st.integers(1, 5), n=st.integers(1, 4), rank=st.integers(1, 6))
@settings(max_examples=25, deadline=None)
def test_what_a_situation_does_to_an_observation_is_linear_in_the_features(
    seed: int, obs_dim: int, n: int, rank: int
) -> None:
    """So that a situation's features are the weighted sum of others' where it is told as their sum."""
    torch.manual_seed(seed)
    features, s = Features(obs_dim, n, rank).double(), torch.randn(3, obs_dim, dtype=torch.float64)
    first, second = torch.randn(2, 3, n, dtype=torch.float64)

    def products(c: torch.Tensor) -> torch.Tensor:
        seen: torch.Tensor = features(torch.cat([s, c], dim=-1))
        assert torch.equal(seen[:, : obs_dim + n], torch.cat([s, c], dim=-1))
        assert seen.shape == (3, features.size)
        return seen[:, obs_dim + n :]

    expected = products(first) + 2.0 * products(second)
    torch.testing.assert_close(products(first + 2.0 * second), expected)
    assert not products(torch.zeros_like(first)).any()  # nothing is told


def test_actor_that_is_told_nothing_acts_as_without_products() -> None:
    torch.manual_seed(0)
    ours, obs, first = ActorCritic(3, 2, 4, hidden=(8,)), torch.randn(5, 3), torch.eye(4)[0]
    ours.mean[3:], ours.std[3:] = 0.25, 0.4
    before = ours.act(obs, ours.untold), ours.value(obs, ours.untold)
    told = ours.act(obs, first)
    with torch.no_grad():
        ours.actor_features.of_obs.weight.zero_()
        ours.critic_features.of_obs.weight.zero_()
    for mine, theirs in zip(before, (ours.act(obs, ours.untold), ours.value(obs, ours.untold)), strict=True):
        torch.testing.assert_close(mine, theirs)
    assert (ours.act(obs, first) != told).any()
