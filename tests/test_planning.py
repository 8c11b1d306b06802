from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent.models.reward import Objective
from famle_agent.models.simulator import imagine
from famle_agent.planning import ICEM, MPPI, Planner, RandomShooting, coloured_noise, shift

PLANNERS = {
    "random shooting": lambda H: RandomShooting(H, candidates=3000),
    "icem": lambda H: ICEM(H, candidates=100, iterations=8),
    "icem, white": lambda H: ICEM(H, candidates=100, iterations=8, noise_beta=0.0),
    "mppi": lambda H: MPPI(H, candidates=200, iterations=5),
}
every_planner = pytest.mark.parametrize("make", PLANNERS.values(), ids=PLANNERS)
Make = Callable[[int], Planner]


def point_mass(obs: Tensor, action: Tensor) -> Tensor:
    """A point in the plane whose velocity is the action."""
    return obs + 0.1 * action


def judge_for(goal: Tensor, obs: Tensor | None = None) -> Callable[[Tensor], Tensor]:
    """The return of plans of B points with goals (B, 2)."""

    def reward(_: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
        return -(next_obs - goal[:, None]).square().sum(dim=-1)

    start = torch.zeros_like(goal) if obs is None else obs
    return lambda tau: imagine(point_mass, Objective(reward), start, tau)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def plan(planner: Planner, judge: Callable[[Tensor], Tensor], robots: int = 1, seed: int = 0) -> tuple[Tensor, Tensor]:
    return planner.plan(judge, torch.zeros(robots, planner.horizon, 2), generator(seed))


# --- what is found ----------------------------------------------------------------------------------------


@every_planner
def test_far_goal_is_approached_at_full_speed(make: Make) -> None:
    judge = judge_for(torch.tensor([[4.0, -4.0]]))
    best = judge(torch.tensor([1.0, -1.0]).expand(1, 1, 5, 2))
    _, tau = plan(make(5), judge)
    zero = judge(torch.zeros(1, 1, 5, 2))
    assert judge(tau[:, None]) > zero + 0.6 * (best - zero)


@pytest.mark.parametrize("name", ["icem", "icem, white", "mppi"])
def test_refined_plans_are_nearly_optimal(name: str) -> None:
    judge = judge_for(torch.tensor([[4.0, -4.0]]))
    action, tau = plan(PLANNERS[name](5), judge)
    best, zero = (judge(torch.tensor(a).expand(1, 1, 5, 2)) for a in ([1.0, -1.0], [0.0, 0.0]))
    assert judge(tau[:, None]) > zero + 0.9 * (best - zero)
    assert action[0, 0] > 0.7
    assert action[0, 1] < -0.7


@pytest.mark.parametrize("name", ["icem", "mppi"])
def test_point_comes_to_its_goal_and_stays(name: str) -> None:
    """Closed loop, each plan beginning from the last one."""
    planner, goal = PLANNERS[name](5), torch.tensor([[0.5, -0.25]])
    obs, start, source = torch.zeros(1, 2), torch.zeros(1, 5, 2), generator()
    for _ in range(15):
        action, tau = planner.plan(judge_for(goal, obs), start, source)
        obs, start = point_mass(obs, action), shift(tau)
    assert (obs - goal).norm() < 0.05


@every_planner
def test_robots_of_a_batch_have_their_own_goals(make: Make) -> None:
    goals = torch.tensor([[4.0, 4.0], [-4.0, 4.0], [4.0, -4.0]])
    _, tau = plan(make(3), judge_for(goals), robots=3)
    assert torch.equal(tau.mean(dim=1).sign(), goals.sign())


@every_planner
def test_horizon_of_one(make: Make) -> None:
    action, tau = plan(make(1), judge_for(torch.tensor([[4.0, -4.0]])))
    assert tau.shape == (1, 1, 2)
    assert action[0, 0] > 0.5
    assert action[0, 1] < -0.5


def test_random_shooting_takes_the_best_candidate() -> None:
    seen: list[Tensor] = []
    judge = judge_for(torch.tensor([[1.0, 2.0], [-1.0, 0.0]]))

    def watch(tau: Tensor) -> Tensor:
        seen.append(tau)
        return judge(tau)

    action, tau = plan(RandomShooting(4, 50), watch, robots=2)
    assert seen[0].shape == (2, 50, 4, 2)
    for robot in range(2):
        best = judge(seen[0])[robot].argmax()
        assert torch.equal(tau[robot], seen[0][robot, best])
        assert torch.equal(action[robot], tau[robot, 0])


def test_icem_never_forgets_its_best_candidate() -> None:
    """What it applies is the best it has judged in the last iteration, and elites are judged again."""
    returns: list[Tensor] = []
    judge = judge_for(torch.tensor([[4.0, -4.0]]))

    def watch(tau: Tensor) -> Tensor:
        returns.append(judge(tau))
        return returns[-1]

    plan(ICEM(5, candidates=30, iterations=6), watch)
    best = torch.stack([value.max() for value in returns])
    assert (best.diff() >= -1e-6).all()


@pytest.mark.parametrize("name", ["icem", "mppi"])
def test_last_plan_competes(name: str) -> None:
    """A plan that is optimal already is kept, however wild the noise."""
    perfect = torch.tensor([1.0, -1.0]).expand(1, 5, 2)
    judge = judge_for(torch.tensor([[40.0, -40.0]]))
    action, _ = PLANNERS[name](5).plan(judge, perfect, generator())
    torch.testing.assert_close(action, perfect[:, 0], atol=0.05, rtol=0)


def test_icem_with_fewer_candidates_than_elites() -> None:
    action, tau = plan(ICEM(3, candidates=2, elites=10), judge_for(torch.zeros(1, 2)))
    assert action.isfinite().all()
    assert tau.shape == (1, 3, 2)


# --- chance -----------------------------------------------------------------------------------------------


@every_planner
def test_same_generator_same_plan(make: Make) -> None:
    judge, state = judge_for(torch.tensor([[0.3, 0.1]])), torch.get_rng_state()
    one, same, other = (plan(make(4), judge, seed=seed)[1] for seed in (0, 0, 1))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert torch.equal(torch.get_rng_state(), state)


@every_planner
def test_candidates_and_plans_stay_in_range(make: Make) -> None:
    judge = judge_for(torch.tensor([[100.0, -100.0]]))

    def watch(tau: Tensor) -> Tensor:
        assert tau.abs().max() <= 1.0
        return judge(tau)

    action, tau = plan(make(5), watch)
    assert action.abs().max() <= 1.0
    assert tau.abs().max() <= 1.0 + 1e-6


@given(st.integers(1, 40), st.floats(0.0, 4.0), st.integers(1, 3))
def test_noise_has_unit_variance_and_no_mean(horizon: int, beta: float, action_dim: int) -> None:
    n = 4000
    noise = coloured_noise(torch.zeros(2, horizon, action_dim), n, beta, generator())
    assert noise.shape == (2, n, horizon, action_dim)
    flat = noise.transpose(0, 2).reshape(horizon, -1)
    assert (flat.std(dim=1) - 1.0).abs().max() < 0.06
    assert flat.mean(dim=1).abs().max() < 0.06


def test_noise_is_smoother_for_a_steeper_spectrum() -> None:
    like, roughness = torch.zeros(1, 20, 1), []
    for beta in (0.0, 1.0, 2.0, 4.0):
        noise = coloured_noise(like, 500, beta, generator())
        roughness.append(noise.diff(dim=2).square().mean().item())
    assert roughness == sorted(roughness, reverse=True)
    assert roughness[0] == pytest.approx(2.0, rel=0.1)  # independent steps


# --- what a model may do wrong ----------------------------------------------------------------------------


@every_planner
@pytest.mark.parametrize("broken", [math.nan, math.inf, -math.inf])
def test_candidates_that_leave_the_numbers_are_never_chosen(make: Make, broken: float) -> None:
    """The model breaks down where the first motor is driven forwards; the second one matters as ever."""

    def model(obs: Tensor, action: Tensor) -> Tensor:
        return torch.where(action[..., :1] > 0, broken, point_mass(obs, action))

    def judge(tau: Tensor) -> Tensor:
        return imagine(model, Objective(lambda obs, action, next_obs: next_obs[..., 1]), torch.zeros(1, 2), tau)

    action, tau = plan(make(1), judge)
    assert action[0, 0] <= 0.0
    assert action[0, 1] > 0.5
    assert tau.isfinite().all()


@every_planner
def test_model_that_is_broken_everywhere_gives_numbers_all_the_same(make: Make) -> None:
    action, tau = plan(make(3), lambda tau: torch.full(tau.shape[:2], -math.inf))
    assert action.isfinite().all()
    assert tau.isfinite().all()
    assert action.abs().max() <= 1.0


@every_planner
def test_equal_returns_are_no_problem(make: Make) -> None:
    action, tau = plan(make(3), lambda tau: torch.zeros(tau.shape[:2]))
    assert action.isfinite().all()
    assert tau.isfinite().all()


# --- the parts --------------------------------------------------------------------------------------------


def test_shift_moves_on_and_repeats_the_last_action() -> None:
    tau = torch.arange(6.0).view(1, 3, 2)
    assert shift(tau).tolist() == [[[2.0, 3.0], [4.0, 5.0], [4.0, 5.0]]]
    assert torch.equal(shift(tau[:, :1]), tau[:, :1])


# --- proposals --------------------------------------------------------------------------------------------


@every_planner
@given(seed=st.integers(0, 1000))
def test_plan_that_somebody_proposes_competes(make: Make, seed: int) -> None:
    """The only plan that is worth anything is found, which no planner would find by itself."""
    planner, chance = make(6), generator(seed)
    needle = 2.0 * torch.rand(2, 1, 6, 2, generator=chance) - 1.0

    def judge(tau: Tensor) -> Tensor:
        return -1e3 * (tau - needle).square().sum(dim=(2, 3))

    hay = 2.0 * torch.rand(2, 3, 6, 2, generator=chance) - 1.0
    proposals = torch.cat([hay, needle], dim=1)
    action, _ = planner.plan(judge, torch.zeros(2, 6, 2), chance, proposals)
    torch.testing.assert_close(action, needle[:, 0, 0], atol=0.05, rtol=0.0)
