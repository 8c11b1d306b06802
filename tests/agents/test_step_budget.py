"""A step that has to be planned, and learnt from, in time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

import pytest
import torch
from torch import Tensor

from famle_agent import FAMLEWrapper
from famle_agent.agents.agent import ModelBasedAgent
from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.simulator import Simulator
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
    assert deadline.left_out == 5 - iterations
    assert deadline.passed == (ms < 10)


def test_random_shooting_has_one_iteration() -> None:
    clock = Clock()
    deadline = Deadline(5.0, clock=clock)
    found = plan(RandomShooting(), clock.judging(0.01), deadline)
    assert torch.equal(found[1], plan(RandomShooting(), JUDGED)[1])
    assert deadline.passed
    assert deadline.left_out == 0


# 5 ms have passed before the steps begin, and each takes 10 ms.
@pytest.mark.parametrize(("ms", "known", "taken"), [(4, 0, 0), (6, 0, 1), (6, 10, 0), (25, 10, 2), (1000, 10, 5)])
def test_gradient_steps_for_which_there_is_no_time_are_left_out(ms: float, known: float, taken: int) -> None:
    clock = Clock()
    deadline = Deadline(ms, turn_ms=known, clock=clock)
    clock.time += 0.005
    torch.manual_seed(0)
    model = Dynamics(2, 1, n_situations=1, embedding_dim=2, hidden=(6,))
    data = Batch(torch.randn(1, 8, 3), torch.randn(1, 8, 2), torch.ones(1, 8))

    def sample() -> Batch:
        clock.time += 0.01
        return data

    def result(steps: int, deadline: Deadline | None = None) -> Tensor:
        theta, h = model.theta_of(1), model.embeddings_of(torch.zeros(1, dtype=torch.long))
        return InnerLoop(steps, optimizer="adam")(model, theta, h, sample, deadline)[1]

    assert torch.equal(result(5, deadline), result(taken))
    assert deadline.left_out == 5 - taken
    assert deadline.turn_ms == pytest.approx(10.0 if taken else known)


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


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """A clock by which each iteration of a planner and each gradient step takes 10 ms, and the rest no time."""
    clock = Clock()

    def taking_time(do: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def slowly(*args: Any) -> Tensor:
            clock.time += 0.01
            return do(*args)

        return slowly

    monkeypatch.setattr("famle_agent.agents.online_adaptation.Deadline", partial(Deadline, clock=clock))
    monkeypatch.setattr(Simulator, "returns", taking_time(Simulator.returns))
    monkeypatch.setattr(Dynamics, "loss", taking_time(Dynamics.loss))
    return clock


def late_after_each_step(agent: ModelBasedAgent, passes_state: bool, steps: int = 4) -> list[tuple[int, ...]]:
    """What has been counted after each control step: overruns, plans that were cut short, gradient steps left out."""
    robot = Cart() if passes_state else FAMLEWrapper(Cart(), agent)
    obs, _ = robot.reset(seed=0)
    state, counts = None, []
    for _ in range(steps):
        action, new = agent.predict(obs, state)
        state = new if passes_state else None
        obs, *_ = robot.step(action)
        counts.append(tuple(agent.health()[name] for name in ("overruns", "cut_short", "left_out")))
    return counts


@pytest.mark.parametrize(
    ("ms", "expected"),
    [
        (51.0, [(0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0)]),  # two iterations and three gradient steps
        (45.0, [(0, 0, 1), (0, 0, 2), (0, 0, 3), (0, 0, 4)]),
        (25.0, [(1, 0, 2), (1, 0, 5), (1, 0, 8), (1, 0, 11)]),  # how long a gradient step takes has to be seen once
        (5.0, [(1, 1, 3), (2, 2, 6), (3, 3, 9), (4, 4, 12)]),  # the first iteration is always due
    ],
)
def test_adaptation_gets_what_the_plan_before_it_has_left(
    slow: Clock, ms: float, expected: list[tuple[int, ...]]
) -> None:
    agent = agent_of(planner_iterations=2, adapt_every=1, step_budget_ms=ms)
    assert late_after_each_step(agent, passes_state=False) == expected


def test_gradient_step_that_was_slow_once_is_tried_again(slow: Clock) -> None:
    agent = agent_of(planner_iterations=2, adapt_every=1, adapt_steps=1, step_budget_ms=40.0)
    env = FAMLEWrapper(Cart(), agent)
    obs, _ = env.reset(seed=0)
    loss, left_out = Dynamics.loss, []
    for step in range(25):
        action = agent.predict(obs)[0]
        with pytest.MonkeyPatch.context() as once:
            if step == 0:
                once.setattr(Dynamics, "loss", lambda *args: (setattr(slow, "time", slow.time + 0.1), loss(*args))[1])
            obs, *_ = env.step(action)
        left_out.append(agent.health()["left_out"])
    assert left_out[5] == 5
    assert left_out[-1] == left_out[-2] < 20


@pytest.mark.parametrize(
    ("ms", "expected"),
    [
        (51.0, [(0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0)]),
        (45.0, [(0, 0, 0), (0, 0, 1), (0, 0, 2), (0, 0, 3)]),
        (25.0, [(0, 0, 0), (0, 1, 2), (0, 1, 5), (0, 1, 8)]),
        (15.0, [(0, 1, 0), (0, 2, 3), (0, 3, 6), (0, 4, 9)]),  # no gradient steps where a plan lacks time
    ],
)
def test_adaptation_leaves_time_for_the_plan_after_it(slow: Clock, ms: float, expected: list[tuple[int, ...]]) -> None:
    agent = agent_of(planner_iterations=2, adapt_every=1, step_budget_ms=ms)
    assert late_after_each_step(agent, passes_state=True) == expected


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
