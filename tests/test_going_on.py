"""FAMLE with ``keep_adapting``: on from theta* and h*, anew where another embedding explains the robot better."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent import FAMLE, Transitions
from famle_agent.adaptation import Belief, better_explained, descend, select
from famle_agent.memory import Memory

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
        settings = {"keep_adapting": True, "selection_size": WINDOW, "memory_size": 40, "adapt_batch_size": 0}
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
    return agent._to_env(torch.as_tensor(action))


def memory(agent: FAMLE) -> Memory:
    assert agent._live is not None
    return agent._live.memory


# --- what a memory says -----------------------------------------------------------------------------------


def random_memory(robots: int, size: int, candidates: int, seed: int) -> Memory:
    """Places of which some are empty; as many of the newest judge as the seed says."""
    chance, window = torch.Generator().manual_seed(seed), 1 + seed % size
    obs, action, next_obs = (torch.randn(robots, size, n, generator=chance) for n in (2, 1, 2))
    log_p, own = (torch.randn(robots, window, n, generator=chance) for n in (candidates, 1))
    weight = torch.rand(robots, size, generator=chance) > 0.3
    return Memory(obs, action, next_obs, log_p, own[..., 0], weight.float())


sizes = st.integers(1, 4), st.integers(1, 7), st.integers(1, 3), st.integers(0, 99)


@given(*sizes, st.integers(0, 8))
def test_robot_that_begins_anew_keeps_its_newest_transitions(
    robots: int, size: int, candidates: int, seed: int, newest: int
) -> None:
    old = random_memory(robots, size, candidates, seed)
    rows, candidate = torch.rand(robots) > 0.5, torch.randint(candidates, (robots,))
    new = old.begun_anew(rows, newest, candidate)
    for robot in range(robots):
        kept = slice(max(0, size - newest), size)
        if rows[robot]:
            assert new.weight[robot].sum() == old.weight[robot, kept].sum()
            assert torch.equal(new.weight[robot, kept], old.weight[robot, kept])
            assert torch.equal(new.own_log_p[robot], old.log_p[robot, :, candidate[robot]])
        else:
            assert torch.equal(new.weight[robot], old.weight[robot])
            assert torch.equal(new.own_log_p[robot], old.own_log_p[robot])
    assert new.obs is old.obs


@given(*sizes)
def test_candidate_is_better_where_it_explains_what_counts_better(
    robots: int, size: int, candidates: int, seed: int
) -> None:
    seen, candidate = random_memory(robots, size, candidates, seed), torch.randint(candidates, (robots,))
    better = better_explained(seen, candidate)
    for robot in range(robots):
        counts = seen.weight[robot, -seen.own_log_p.shape[1] :] == 1
        theirs, own = seen.log_p[robot, counts, candidate[robot]].sum(), seen.own_log_p[robot, counts].sum()
        assert better[robot] == (theirs > own) or torch.isclose(theirs, own)


@given(*sizes)
def test_what_explains_as_well_as_the_belief_is_not_better(robots: int, size: int, candidates: int, seed: int) -> None:
    seen, everyone = random_memory(robots, size, candidates, seed), torch.ones(robots, dtype=torch.bool)
    candidate = torch.randint(candidates, (robots,))
    assert not better_explained(seen.begun_anew(everyone, size, candidate), candidate).any()


@given(*sizes, st.integers(1, 9), st.integers(1, 9))
def test_resized_memory_keeps_the_newest(
    robots: int, size: int, candidates: int, seed: int, new_size: int, window: int
) -> None:
    old = random_memory(robots, size, candidates, seed)
    new = old.resized(new_size, window)
    assert new.weight.shape == (robots, new_size)
    assert new.log_p.shape == (robots, min(window, new_size), candidates)
    for name, values in vars(old).items():
        fitted = getattr(new, name)
        both = min(values.shape[1], fitted.shape[1])
        assert torch.equal(fitted[:, fitted.shape[1] - both :], values[:, values.shape[1] - both :])
        assert not fitted[:, : fitted.shape[1] - both].any()


@given(*sizes)
def test_only_what_judges_has_a_likelihood(robots: int, size: int, candidates: int, seed: int) -> None:
    seen = random_memory(robots, size, candidates, seed)
    window, new = seen.own_log_p.shape[1], torch.rand(robots, candidates)
    log_p, own = torch.cat([seen.log_p, new[:, None]], dim=1), torch.cat([seen.own_log_p, new[:, :1]], dim=1)
    everyone = torch.ones(robots, dtype=torch.bool)
    seen = seen.add(seen.obs[:, 0], seen.action[:, 0], seen.obs[:, 0], new, new[:, 0], valid=everyone)
    assert torch.equal(seen.log_p, log_p[:, -window:])
    assert torch.equal(seen.own_log_p, own[:, -window:])
    assert torch.equal(seen.judging, seen.weight[:, size - window :])


@given(st.lists(st.booleans(), min_size=1, max_size=4))
def test_memories_are_mixed_by_robot(kept: list[bool]) -> None:
    mine, theirs = (random_memory(len(kept), 3, 2, seed) for seed in (1, 4))
    mixed = mine.where(torch.tensor(kept), theirs)
    for robot, keep in enumerate(kept):
        for name, values in vars(mixed).items():
            assert torch.equal(values[robot], getattr(mine if keep else theirs, name)[robot])


# --- life -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keep_adapting", [True, False])
def test_belief_is_judged_by_what_it_has_not_seen(load: Load, data: Transitions, keep_adapting: bool) -> None:
    agent = load(keep_adapting=keep_adapting)
    model = agent._require_dynamics()
    for i in range(8):
        before: Belief = agent._state_of(1).belief
        tell(agent, data, [DEAD], range(i, i + 1))
        seen = memory(agent)
        newest = model.encode(*(values[:, -1:] for values in (seen.obs, seen.action, seen.next_obs)))
        expected = before.log_likelihood(model, newest)[:, 0] if keep_adapting else torch.zeros(1)
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
        before = agent._state_of(len(situations)).belief
        tell(agent, data, situations, range(i, i + 1))
        if agent.belief.adaptations > before.adaptations:
            yield before, agent.belief, memory(agent).weight.sum(dim=1) <= WINDOW


def test_steps_go_on_as_long_as_no_embedding_is_better(load: Load, data: Transitions) -> None:
    agent = load()
    model, steps = agent._require_dynamics(), agent.hyperparameters.adaptation(0)
    tell(agent, data, [STRANGE], range(30))
    seen = memory(agent).seen
    for before, after, anew in after_each_adaptation(agent, data, [STRANGE], range(30, 39)):
        assert not anew.any()
        expected = descend(model, before, memory(agent), steps)
        torch.testing.assert_close(after.h, expected.h)
        torch.testing.assert_close(after.theta, expected.theta)
    assert memory(agent).seen == seen + 9


def test_agent_begins_anew_where_the_situation_changes(load: Load, data: Transitions) -> None:
    agent = load()
    model, steps = agent._require_dynamics(), agent.hyperparameters.adaptation(0)
    tell(agent, data, [STRANGE], range(30))
    assert memory(agent).seen > WINDOW
    began = 0
    for before, after, anew in after_each_adaptation(agent, data, [REVERSED], range(30, 39)):
        if anew.all():
            began += 1
            expected = descend(model, select(model, agent._candidates(), after), memory(agent), steps)
            torch.testing.assert_close(after.h, expected.h)
            torch.testing.assert_close(after.theta, expected.theta)
            assert not torch.equal(before.h, after.h)
            assert memory(agent).seen == WINDOW
    assert began
    assert max(agent.posterior(), key=lambda name: agent.posterior()[name]) == "joint 0 reversed"


def imagined(agent: FAMLE, belief: Belief, data: Transitions) -> Tensor:
    """What a planner with a belief expects of some actions."""
    obs, action = (torch.as_tensor(values[DEAD, :20])[None] for values in (data.obs, data.action))
    return agent._require_dynamics().simulator(belief.theta, belief.h)(obs, action)


def planned_with(agent: FAMLE, data: Transitions) -> Tensor:
    """The same of the model that the agent plans with."""
    obs, action = (torch.as_tensor(values[DEAD, :20])[None] for values in (data.obs, data.action))
    return agent._simulator(agent.belief, memory(agent))(obs, action)


def test_adapted_model_plans_where_no_embedding_is_better(load: Load, data: Transitions) -> None:
    agent = load()
    tell(agent, data, [STRANGE], range(30))
    assert not better_explained(memory(agent), agent.belief.log_posterior.argmax(dim=1)).any()
    torch.testing.assert_close(planned_with(agent, data), imagined(agent, agent.belief, data))


def test_embedding_alone_plans_while_steps_lead_astray_and_nothing_is_forgotten(load: Load, data: Transitions) -> None:
    agent = load(adapt_lr=0.3)
    tell(agent, data, [DEAD], range(30))
    selected = select(agent._require_dynamics(), agent._candidates(), agent.belief)
    assert better_explained(memory(agent), selected.candidate).all()
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
