"""A step that has to be planned in time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

import pytest
import torch
from torch import Tensor

from famle_agent import FAMLEWrapper
from famle_agent.planning import ICEM, MPPI, Planner, RandomShooting
from famle_agent.utils.deadline import Deadline
from tests.agents.test_sensors import Cart, agent_of

JUDGED: Callable[[Tensor], Tensor] = lambda tau: -(tau - 0.5).square().sum(dim=(2, 3))  # noqa: E731


class Clock:
    """A clock that moves when it is told to."""

    def __init__(self) -> None:
        self.time = 0.0

    def __call__(self) -> float:
        return self.time

    def judging(self, seconds: float) -> Callable[[Tensor], Tensor]:
        """A judge that takes its time."""

        def judge(tau: Tensor) -> Tensor:
            self.time += seconds
            return JUDGED(tau)

        return judge


def plan(planner: Planner, judge: Any, deadline: Deadline | None = None) -> tuple[Tensor, Tensor]:
    return planner.plan(judge, torch.zeros(2, 4, 3), torch.Generator().manual_seed(0), None, deadline)


@pytest.mark.parametrize("kind", [ICEM, MPPI])
@pytest.mark.parametrize(("ms", "iterations"), [(0.1, 1), (10.0, 1), (25.0, 2), (30.0, 3), (1000.0, 5)])
def test_planner_returns_its_best_plan_so_far(kind: type[Any], ms: float, iterations: int) -> None:
    """Each iteration takes 10 ms; none begins that would not end in time, but the first."""
    clock = Clock()
    deadline = Deadline(ms, clock=clock)
    found = plan(kind(iterations=5), clock.judging(0.01), deadline)
    assert clock.time == pytest.approx(0.01 * iterations)
    for ours, theirs in zip(found, plan(kind(iterations=iterations), JUDGED), strict=True):
        assert torch.equal(ours, theirs)
    assert deadline.cut_short == (iterations < 5)
    assert deadline.passed == (ms < 10)


def test_random_shooting_has_one_iteration() -> None:
    clock = Clock()
    deadline = Deadline(5.0, clock=clock)
    found = plan(RandomShooting(), clock.judging(0.01), deadline)
    assert torch.equal(found[1], plan(RandomShooting(), JUDGED)[1])
    assert deadline.passed
    assert not deadline.cut_short


@pytest.mark.parametrize("passes_state", [False, True])
def test_overruns_are_counted(monkeypatch: pytest.MonkeyPatch, passes_state: bool) -> None:
    ticks = count()
    slow = partial(Deadline, clock=lambda: 0.01 * next(ticks))  # each look at the clock takes 10 ms
    monkeypatch.setattr("famle_agent.agents.online_adaptation.Deadline", slow)
    late, in_time = (agent_of(planner_iterations=4, step_budget_ms=ms) for ms in (5.0, 1000.0))
    for agent in (late, in_time):
        robot = Cart()
        obs, _ = robot.reset(seed=0)
        state = None
        for _ in range(3):
            action, new = agent.predict(obs, state)
            state = new if passes_state else None
            obs, *_ = robot.step(action)
    assert [late.health()[name] for name in ("overruns", "cut_short")] == [3, 3]
    assert [in_time.health()[name] for name in ("overruns", "cut_short")] == [0, 0]


def test_info_counts_overruns() -> None:
    agent = agent_of(step_budget_ms=1e-6)
    env = FAMLEWrapper(Cart(), agent)
    obs, info = env.reset(seed=0)
    assert info["famle"]["overruns"] == 0
    obs, _, _, _, info = env.step(agent.predict(obs)[0])
    assert info["famle"]["overruns"] == 1


def test_budget_that_is_not_needed_changes_nothing() -> None:
    obs, _ = Cart().reset(seed=0)
    plain, budgeted = agent_of(), agent_of(step_budget_ms=1e6)
    for _ in range(3):
        assert (plain.predict(obs)[0] == budgeted.predict(obs)[0]).all()


@pytest.mark.parametrize("ms", [0.0, -1.0])
def test_budget_of_nothing_is_refused(ms: float) -> None:
    with pytest.raises(ValueError, match="step_budget_ms must be"):
        agent_of(step_budget_ms=ms)
