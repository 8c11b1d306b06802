"""FAMLE with ``warm_start``: on from theta* and h*, anew where another embedding explains the robot better."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from famle_agent import FAMLE, Transitions
from famle_agent.adaptation.belief import Belief
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.update import descend, select
from famle_agent.data.action_scaling import to_action_space
from famle_agent.models.simulator import Simulator
from tests.helpers import log_likelihood

WINDOW = 6
DEAD, REVERSED, STRANGE = 4, 6, 11  # joint 3 dead, joint 0 reversed, and what was not trained
ARRAYS = ("obs", "action", "reward", "next_obs")

Load = Callable[..., FAMLE]


@pytest.fixture(scope="module")
def data(transitions: Transitions) -> Transitions:
    """What robots in each training situation go through, and one in a situation that was not trained."""
    other = -0.5 * transitions.action[:1]
    rows = {name: np.concatenate([getattr(transitions, name), getattr(transitions, name)[:1]]) for name in ARRAYS}
    rows["action"][STRANGE] = other
    return replace(transitions, **rows, situations=(*transitions.situations, "strange"))


@pytest.fixture
def load(agent_file: Path) -> Iterator[Load]:
    """Loads an agent that goes on; all are closed in the end."""
    agents = []

    def loaded(**overrides: object) -> FAMLE:
        settings = {"warm_start": True, "selection_size": WINDOW, "memory_size": 40, "adapt_batch_size": 0}
        steps = {"adapt_every": 3, "adapt_steps": 10, "planner_iterations": 1}
        agents.append(FAMLE.load(agent_file, device="cpu", **{**settings, **steps, **overrides}))
        return agents[-1]

    yield loaded
    for agent in agents:
        agent.get_env().close()


def tell(agent: FAMLE, data: Transitions, situations: list[int], steps: range) -> None:
    """Tells the agent what its robots, one in each situation, go through."""
    for i in steps:
        agent.observe(
            data.obs[situations, i], agent_units(agent, data.action[situations, i]), data.next_obs[situations, i]
        )


def agent_units(agent: FAMLE, action: object) -> object:
    """Actions of the model, in [-1, 1], as the environment's."""
    return to_action_space(torch.as_tensor(action), agent.action_space)


def memory(agent: FAMLE) -> Memory:
    return agent.state_of(len(agent.belief.candidate)).memory


# --- life -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("warm_start", [True, False])
def test_belief_is_judged_by_what_it_has_not_seen(load: Load, data: Transitions, warm_start: bool) -> None:
    agent = load(warm_start=warm_start)
    model = agent.model
    for i in range(8):
        before: Belief = agent.state_of(1).belief
        tell(agent, data, [DEAD], range(i, i + 1))
        seen = memory(agent)
        newest = model.encode(*(values[:, -1:] for values in (seen.obs, seen.action, seen.next_obs)))
        expected = log_likelihood(model, newest, before.h, before.theta)[:, 0] if warm_start else torch.zeros(1)
        if agent.belief.adaptations == before.adaptations:  # else it may have begun anew
            torch.testing.assert_close(seen.own_log_p[:, -1], expected)


def test_first_belief_is_the_first_candidate(load: Load, data: Transitions) -> None:
    agent = load(adapt_every=1000)
    tell(agent, data, [DEAD], range(5))
    torch.testing.assert_close(memory(agent).own_log_p, memory(agent).log_p[..., 0], rtol=1e-4, atol=1e-3)


def after_each_adaptation(
    agent: FAMLE, data: Transitions, situations: list[int], steps: range
) -> Iterator[tuple[Belief, Belief, Tensor]]:
    """The belief before and after each adaptation, and which robots it began anew for."""
    for i in steps:
        before = agent.state_of(len(situations)).belief
        tell(agent, data, situations, range(i, i + 1))
        if agent.belief.adaptations > before.adaptations:
            yield before, agent.belief, before.candidate != agent.belief.candidate


def test_steps_go_on_as_long_as_no_embedding_is_better(load: Load, data: Transitions) -> None:
    agent = load()
    model, steps = agent.model, agent.config.adaptation.gradient.inner_loop(0)
    tell(agent, data, [STRANGE], range(30))
    seen = memory(agent).seen
    adaptations = 0
    for before, after, anew in after_each_adaptation(agent, data, [STRANGE], range(30, 39)):
        adaptations += 1
        assert not anew.any()
        expected = descend(model, before, memory(agent), steps)
        torch.testing.assert_close(after.h, expected.h)
        torch.testing.assert_close(after.theta, expected.theta)
    assert adaptations == 3
    assert memory(agent).seen == seen + 9


def test_agent_begins_anew_where_the_situation_changes(load: Load, data: Transitions) -> None:
    agent = load()
    model, steps = agent.model, agent.config.adaptation.gradient.inner_loop(0)
    tell(agent, data, [STRANGE], range(30))
    assert memory(agent).seen > WINDOW
    began = 0
    for before, after, anew in after_each_adaptation(agent, data, [REVERSED], range(30, 39)):
        if anew.all():
            began += 1
            expected = descend(model, select(model, agent.candidates, after), memory(agent), steps)
            torch.testing.assert_close(after.h, expected.h)
            torch.testing.assert_close(after.theta, expected.theta)
            assert not torch.equal(before.h, after.h)
            assert 0 < memory(agent).seen <= WINDOW
    assert began
    assert max(agent.posterior(), key=lambda name: agent.posterior()[name]) == "joint 0 reversed"


def imagined(agent: FAMLE, belief: Belief, data: Transitions) -> Tensor:
    """What a planner with a belief expects of some actions."""
    obs, action = (torch.as_tensor(values[DEAD, :20])[None] for values in (data.obs, data.action))
    return Simulator(agent.model, belief.h, belief.theta)(obs, action)


def planned_with(agent: FAMLE, data: Transitions) -> Tensor:
    """The same of the model that the agent plans with."""
    obs, action = (torch.as_tensor(values[DEAD, :20])[None] for values in (data.obs, data.action))
    return agent.adapter.model_for(agent.belief, memory(agent))(obs, action)


def test_adapted_model_plans_where_no_embedding_is_better(load: Load, data: Transitions) -> None:
    agent = load()
    tell(agent, data, [STRANGE], range(30))
    assert not memory(agent).better_explained(agent.belief.log_posterior.argmax(dim=1)).any()
    torch.testing.assert_close(planned_with(agent, data), imagined(agent, agent.belief, data))


def test_embedding_alone_plans_while_steps_lead_astray_and_nothing_is_forgotten(load: Load, data: Transitions) -> None:
    agent = load(adapt_lr=0.3)
    tell(agent, data, [DEAD], range(30))
    selected = select(agent.model, agent.candidates, agent.belief)
    assert memory(agent).better_explained(selected.candidate).all()
    assert selected.candidate.tolist() == agent.belief.candidate.tolist() == [DEAD]
    assert memory(agent).seen > 2 * WINDOW
    torch.testing.assert_close(planned_with(agent, data), imagined(agent, selected, data))
    assert not torch.allclose(imagined(agent, agent.belief, data), imagined(agent, selected, data))


def test_belief_remembers_with_which_embedding_it_began(load: Load, data: Transitions) -> None:
    agent = load()
    assert agent.belief.candidate.tolist() == [0]
    tell(agent, data, [DEAD], range(12))
    assert agent.belief.candidate.tolist() == [DEAD]
    tell(agent, data, [REVERSED], range(12, 30))
    assert agent.belief.candidate.tolist() == [REVERSED]


def test_each_robot_goes_on_or_begins_anew_by_itself(load: Load, data: Transitions) -> None:
    together, alone = load(), [load(), load()]
    for situations, steps in (([STRANGE, STRANGE], range(30)), ([STRANGE, REVERSED], range(30, 39))):
        tell(together, data, situations, steps)
        for agent, situation in zip(alone, situations, strict=True):
            tell(agent, data, [situation], steps)
    for robot, agent in enumerate(alone):
        assert torch.equal(memory(agent).weight[0], memory(together).weight[robot])
        torch.testing.assert_close(agent.belief.h[0], together.belief.h[robot], rtol=1e-3, atol=1e-3)
    assert memory(together).weight[0].sum() > memory(together).weight[1].sum()


def test_embedding_is_selected_by_the_newest_transitions(load: Load, data: Transitions) -> None:
    agent = load(adapt_every=1000)
    tell(agent, data, [DEAD], range(20))
    tell(agent, data, [REVERSED], range(20, 20 + WINDOW))
    newest = memory(agent).log_p[:, -WINDOW:].sum(dim=1)
    torch.testing.assert_close(agent.belief.posterior, torch.softmax(newest, dim=1))


def test_agent_that_goes_on_is_saved_with_what_it_knows(load: Load, data: Transitions, tmp_path: Path) -> None:
    agent = load()
    tell(agent, data, [DEAD], range(10))
    agent.save(tmp_path / "agent.zip")
    loaded = FAMLE.load(tmp_path / "agent.zip", device="cpu")
    for one in (agent, loaded):
        tell(one, data, [REVERSED], range(10, 22))
    assert torch.equal(memory(agent).own_log_p, memory(loaded).own_log_p)
    assert torch.equal(memory(agent).weight, memory(loaded).weight)
    torch.testing.assert_close(agent.belief.h, loaded.belief.h)
    assert torch.equal(agent.belief.candidate, loaded.belief.candidate)
    loaded.get_env().close()


def test_filtering_robot_that_breaks_late_begins_anew_with_what_it_went_through_since(
    load: Load, data: Transitions
) -> None:
    agent = load(hazard=1e-3, selection_size=0, memory_size=100)
    tell(agent, data, [DEAD], range(60))
    assert agent.belief.candidate.tolist() == [DEAD]
    tell(agent, data, [REVERSED], range(60, 90))
    assert agent.belief.candidate.tolist() == [REVERSED]
    assert memory(agent).seen <= 30  # of 90, most of which speak for the old situation
