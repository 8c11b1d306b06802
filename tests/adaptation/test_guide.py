from __future__ import annotations

import torch
from torch import Tensor

from famle_agent.adaptation.guide import Guide
from famle_agent.models.actor_critic import ActorCritic
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.reward import Objective
from famle_agent.models.simulator import Simulator


def made(n: int = 3, robots: int = 2) -> tuple[Guide, Simulator, Tensor]:
    torch.manual_seed(0)
    model = Dynamics(2, 1, n_situations=n, embedding_dim=2, hidden=(6,), members=2)
    guide = Guide(ActorCritic(2, 1, n, hidden=(5,)).requires_grad_(False), torch.tensor([0.25]), situations=2)
    return guide, Simulator(model, model.embeddings_of(torch.zeros(robots, dtype=torch.long))), torch.randn(robots, 2)


@torch.no_grad()
def test_proposals_are_what_the_actor_would_do_in_the_likely_situations() -> None:
    guide, model, obs = made()
    likely = torch.tensor([[0.1, 0.2, 0.7], [0.6, 0.1, 0.3]])
    proposals = guide.proposals(model, obs, likely, 4, torch.Generator().manual_seed(0))
    assert proposals.shape == (2, 7, 4, 1)  # nothing told and two situations, each as it is and with noise; no action
    assert (proposals[:, 6] == 0.25).all()
    for robot, situations in enumerate(((2, 1), (0, 2))):
        told = torch.stack([guide.actor_critic.untold, *torch.eye(3)[list(situations)]])
        expected = guide.actor_critic.act(obs[robot].expand(3, -1), told)
        torch.testing.assert_close(proposals[robot, :3, 0], expected)
        state = obs[[robot, robot]]
        for t in range(4):  # one robot, one situation, by hand
            action = guide.actor_critic.act(state[robot : robot + 1], told[1])
            torch.testing.assert_close(proposals[robot, 1, t], action[0])
            state = model(state[:, None], action.expand(2, -1)[:, None]).mean(dim=1)[:, 0]
    assert (proposals[:, 3:6] != proposals[:, :3]).any(dim=-1).all()
    assert proposals.abs().max() <= 1.0


@torch.no_grad()
def test_value_of_what_is_most_likely_lies_beyond_a_plan() -> None:
    guide, model, obs = made()
    guide.actor_critic.discount.fill_(0.5)
    shares = torch.tensor([[-1.0, 1.0, 1.0], [0.0, 0.0, 1.0]])  # a sum of two, and one alone
    objective = guide.looking_beyond(Objective(lambda s, a, s_next: s_next[..., 0]), shares, model)
    actions = torch.randn(2, 3, 1, 1).clamp(-1.0, 1.0)
    found = model.returns(objective, obs, actions)
    after = model(obs[:, None].expand(-1, 3, -1), actions[:, :, 0])  # (2, P, 3, obs_dim)
    values = torch.stack([guide.actor_critic.value(after[i], told) for i, told in enumerate(shares)])
    torch.testing.assert_close(found, (after[..., 0] + 0.5 * values).mean(dim=1), rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_plan_is_judged_by_a_lower_bound_of_its_advantage_over_the_policy() -> None:
    guide, model, obs = made()
    objective = Objective(lambda s, a, s_next: s_next[..., 0])
    plans, policy = torch.rand(2, 4, 3, 1) * 2.0 - 1.0, torch.rand(2, 1, 3, 1) * 2.0 - 1.0
    judge = guide.judge(objective, model, obs, policy)
    torch.testing.assert_close(judge(policy), torch.zeros(2, 1))
    first, second = (model.returns_of_members(objective, obs, tau) for tau in (plans, policy))  # (2, 2, N)
    advantage = first - second
    of_two = 0.5 * (advantage[:, 0] + advantage[:, 1]) - 0.5 * (advantage[:, 0] - advantage[:, 1]).abs()
    torch.testing.assert_close(judge(plans), of_two, rtol=1e-4, atol=1e-5)  # of two members that is the smaller one


@torch.no_grad()
def test_plan_that_leaves_the_finite_numbers_is_never_better_than_the_policy() -> None:
    guide, model, obs = made()
    wild = Objective(lambda s, a, s_next: torch.where(a[..., 0] > 0.5, torch.inf, a[..., 0]))
    plans = torch.tensor([-0.5, 0.9, 0.4])[None, :, None, None].expand(2, -1, 3, -1)
    for policy in (-0.5, 0.9):  # and where the policy itself leaves them, a finite plan is better than none
        found = guide.judge(wild, model, obs, torch.full((2, 1, 3, 1), policy))(plans)
        assert found.argmax(dim=1).tolist() == [2, 2]
        assert (found[:, 1] == -torch.inf).all()


def test_nothing_counts_behind_the_end_of_an_episode() -> None:
    _, model, obs = made(robots=1)
    actions = torch.zeros(1, 1, 5, 1)
    ended = Objective(
        lambda s, a, s_next: torch.ones_like(s_next[..., 0]),
        termination_fn=lambda s_next: torch.ones_like(s_next[..., 0], dtype=torch.bool),
        value_fn=lambda s: torch.full_like(s[..., 0], 100.0),
    )
    assert model.returns(ended, obs, actions).item() == 1.0
    for_ever = Objective(ended.reward_fn, lambda s_next: torch.zeros_like(s_next[..., 0]), ended.value_fn, 0.5)
    assert model.returns(for_ever, obs, actions).item() == 1.9375 + 0.5**5 * 100.0
