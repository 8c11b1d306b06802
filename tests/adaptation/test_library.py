"""The library of what robots had learnt before they changed: damage that comes back is recognised."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent import FAMLE, Transitions
from famle_agent.adaptation.adapters import EmbeddingAdapter
from famle_agent.adaptation.library import Library, either, enlarged
from famle_agent.adaptation.memory import Memory
from famle_agent.data.action_scaling import to_action_space

DEAD = 4  # joint 3 dead, which was trained
LEARNT, OTHER, AGAIN = 100, 30, 9  # steps in the damage that was not trained, in the other one, and in the first again
BACK = LEARNT + OTHER

Load = Callable[..., FAMLE]
Tell = Callable[..., None]


@pytest.fixture
def load(agent_file: Path) -> Iterator[Load]:
    """Loads an agent that looks for changes; all are closed in the end."""
    agents = []

    def loaded(path: Path = agent_file, **overrides: object) -> FAMLE:
        settings = {"warm_start": True, "hazard": 1e-3, "likelihood_power": 0.2, "memory_size": 100, "library_size": 2}
        steps = {"adapt_every": 3, "adapt_steps": 10, "adapt_batch_size": 0, "planner_iterations": 1}
        agents.append(FAMLE.load(path, device="cpu", **{**settings, **steps, **overrides}))
        return agents[-1]

    yield loaded
    for agent in agents:
        agent.get_env().close()


@pytest.fixture
def tell(transitions: Transitions) -> Tell:
    """Tells an agent what its robots go through: the damage that was not trained where they are strange, or another."""

    def told(agent: FAMLE, steps: range, strange: Sequence[bool]) -> None:
        situations, factor = np.where(strange, 0, DEAD), np.where(strange, -0.5, 1.0)[:, None]
        for i in steps:
            action = torch.as_tensor(factor * transitions.action[situations, i], dtype=torch.float32)
            obs, next_obs = transitions.obs[situations, i], transitions.next_obs[situations, i]
            agent.observe(obs, to_action_space(action, agent.action_space), next_obs)

    return told


def live(agent: FAMLE, tell: Tell, steps: int = BACK + AGAIN) -> FAMLE:
    """Lets the robot of an agent go through the damage that was not trained, the other one, and the first again."""
    for strange, begin, end in ((True, 0, LEARNT), (False, LEARNT, BACK), (True, BACK, BACK + AGAIN)):
        tell(agent, range(begin, min(end, steps)), [strange])
    return agent


def stored(agent: FAMLE) -> int:
    """How many models there are of the first robot."""
    return 0 if agent.belief.library is None else int(agent.belief.library.full[0].sum())


def loss(agent: FAMLE, transitions: Transitions) -> float:
    """How badly the adapted model predicts the damage that was not trained."""
    new = slice(BACK + AGAIN, None)
    obs, action, next_obs = (
        torch.as_tensor(getattr(transitions, name)[:1, new]) for name in ("obs", "action", "next_obs")
    )
    batch = agent.model.encode(obs, -0.5 * action, next_obs)
    return float(agent.model.loss(batch, agent.belief.h, agent.belief.theta).mean())


# --- damage that comes back -------------------------------------------------------------------------------------------


def test_what_was_learnt_of_damage_is_there_again_within_a_few_steps(
    load: Load, tell: Tell, transitions: Transitions
) -> None:
    losses, seen = {}, {}
    for size in (0, 2):
        agent = live(load(library_size=size), tell)
        losses[size], seen[size] = loss(agent, transitions), agent.state_of(1).memory.seen
    assert losses[2] < 0.2 * losses[0]
    assert seen[2] > LEARNT / 2 > seen[0]  # what it was learnt from is back too


def test_diagnosis_says_that_a_robot_has_been_like_this_before(load: Load, tell: Tell, tmp_path: Path) -> None:
    agent = live(load(), tell, BACK)
    assert not agent.diagnose().recognised
    assert "before" not in str(agent.diagnose())
    tell(agent, range(BACK, BACK + AGAIN), [True])
    agent.save(tmp_path / "agent.zip")
    for one in (agent, load(tmp_path / "agent.zip")):
        assert one.diagnose().recognised
        assert str(one.diagnose()).endswith("The robot has been like this before.")
    tell(agent, range(LEARNT, LEARNT + 3 * AGAIN), [False])  # and is healed again
    assert not agent.diagnose().recognised


def test_library_that_recognises_nothing_changes_nothing(load: Load, tell: Tell) -> None:
    with_library, without = (live(load(library_size=size), tell, BACK) for size in (2, 0))
    assert (stored(with_library), stored(without)) == (1, 0)
    both = (agent.state_of(1).to_tensors() for agent in (with_library, without))
    mine, theirs = ({name: value for name, value in one.items() if not name.startswith("library.")} for one in both)
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(value, theirs[name]) for name, value in mine.items())


@pytest.mark.parametrize("settings", [{"hazard": 0.0, "selection_size": 10}, {"warm_start": False}])
def test_robot_keeps_nothing_where_no_change_is_looked_for(load: Load, tell: Tell, settings: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"library_size needs .*warm_start, and a hazard"):
        load(**settings)
    assert stored(live(load(**settings, library_size=0), tell)) == 0


def test_each_robot_has_its_own(load: Load, tell: Tell) -> None:
    lives = [[True, False], [False, False], [True, False]]
    together, alone = load(), [load(), load()]
    for strange, begin, end in zip(lives, (0, LEARNT, BACK), (LEARNT, BACK, BACK + AGAIN), strict=True):
        tell(together, range(begin, end), strange)
        for agent, one in zip(alone, strange, strict=True):
            tell(agent, range(begin, end), [one])
    assert together.belief.library is not None
    for robot, agent in enumerate(alone):
        assert int(together.belief.library.full[robot].sum()) == stored(agent)
        assert torch.equal(together.state_of(2).memory.weight[robot], agent.state_of(1).memory.weight[0])
        torch.testing.assert_close(together.belief.h[robot], agent.belief.h[0], rtol=0.0, atol=0.2)  # 400 steps add up
        if (own := agent.belief.library) is not None:  # each model as if there were no other robot
            mine = together.belief.library.of_robot(robot).resized(stored(agent), 100, own.log_p.shape[2])
            assert mine is not None
            assert torch.equal(mine.candidate, own.candidate)
            torch.testing.assert_close(mine.log_p, own.log_p, rtol=0.05, atol=0.5)
            torch.testing.assert_close(mine.h, own.h, rtol=0.0, atol=0.2)


@pytest.mark.parametrize("size", [0, 1, 5])
def test_library_is_saved_with_the_agent(load: Load, tell: Tell, tmp_path: Path, size: int) -> None:
    agent = live(load(), tell, BACK)
    agent.save(tmp_path / "agent.zip")
    loaded = load(tmp_path / "agent.zip", library_size=size, memory_size=120)
    assert stored(loaded) == min(size, 1)
    for one in (agent, loaded):
        tell(one, range(BACK, BACK + AGAIN), [True])
    assert (loaded.state_of(1).memory.seen > LEARNT / 2) == (size > 0)


def test_library_is_judged_by_what_the_memory_holds(load: Load, tell: Tell) -> None:
    """Also while the agent does not adapt."""
    agent = live(load(), tell, BACK)
    agent.config = agent.config.changed(adapt_every=0)
    before = agent.state_of(1)
    tell(agent, range(BACK, BACK + 5), [True])
    after = agent.state_of(1)
    assert before.belief.library is not None
    assert after.belief.library is not None
    assert torch.equal(after.memory.own_log_p[:, :-5], before.memory.own_log_p[:, 5:])
    assert torch.equal(after.belief.library.log_p[:, :, :-5], before.belief.library.log_p[:, :, 5:])
    assert (after.belief.library.log_p[:, :, -5:] != before.belief.library.log_p[:, :, -5:]).all()


def test_library_that_an_adapter_does_not_judge_wins_nothing(
    load: Load, tell: Tell, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, judge = live(load(), tell, BACK), EmbeddingAdapter.judge
    agent.config = agent.config.changed(adapt_every=0)
    monkeypatch.setattr(EmbeddingAdapter, "judge", lambda *args: replace(judge(*args), library_log_p=None))
    tell(agent, range(BACK, BACK + AGAIN), [True])
    state = agent.state_of(1)
    assert state.belief.library is not None
    assert torch.equal(state.belief.library.log_p[0, 0, -AGAIN:], state.memory.own_log_p[0, -AGAIN:])


@pytest.mark.parametrize("seed", range(20))
def test_robots_of_a_batch_go_on_as_if_alone(load: Load, seed: int) -> None:
    agent, chance, robots = load(adapt_lr=0.0, adapt_embedding_lr=0.0), torch.Generator().manual_seed(seed), 3
    state = agent.policy.initial(robots)
    initial, empty = state.belief, state.memory

    def some(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=chance)

    def memory() -> Memory:
        weight = (torch.rand(empty.weight.shape, generator=chance) > 0.2).float()
        return replace(empty, log_p=2.0 * some(empty.log_p) - 4.0, own_log_p=3.0 * some(empty.own_log_p), weight=weight)

    library = None
    for _ in range(2):
        full = torch.rand(robots, generator=chance) > 0.4
        one = Library.of(initial.theta, some(initial.h), initial.candidate, memory(), full)
        library = replace(one, log_p=3.0 * some(one.log_p)).followed_by(library, 2)
    belief, seen = replace(initial, library=library, log_posterior=some(initial.log_posterior)), memory()
    together_memory, together = agent.adapter.adapt(seen, belief)
    for robot in range(robots):
        of_one = seen.each(lambda values, robot=robot: values[robot : robot + 1])
        alone_memory, alone = agent.adapter.adapt(of_one, belief.of(robot))
        for name, value in vars(alone_memory).items():
            assert torch.equal(getattr(together_memory, name)[robot], value[0])
        assert torch.equal(together.h[robot], alone.h[0])
        assert together.candidate[robot] == alone.candidate[0]
        assert models(together.library, robot) == models(alone.library, 0)


def test_agent_that_forgets_has_no_library(load: Load, tell: Tell) -> None:
    agent = live(load(), tell, BACK)
    agent.forget()
    assert stored(agent) == 0


# --- what is kept -----------------------------------------------------------------------------------------------------


def library_of(full: Tensor, values: Tensor) -> Library:
    """A library whose models all have one number each, (B, L)."""
    one = values[..., None]
    memory = Memory(*[one[..., None]] * 4, one, one)
    return Library({"w": one}, one, torch.zeros_like(full, dtype=torch.long), memory, one, full)


def models(library: Library | None, robot: int) -> list[float]:
    """The numbers of a robot's models."""
    return [] if library is None else library.h[robot, library.full[robot]].flatten(1)[:, 0].tolist()


full_or_not = st.integers(1, 3).flatmap(
    lambda robots: st.tuples(
        *[st.lists(st.lists(st.booleans(), min_size=n, max_size=n), min_size=robots, max_size=robots) for n in (2, 3)]
    )
)


@given(full_or_not, st.integers(1, 5))
def test_newest_models_come_first_and_the_oldest_go(full: tuple[list[list[bool]], list[list[bool]]], size: int) -> None:
    first, second = (torch.tensor(one) for one in full)
    mine, theirs = (library_of(one, torch.randn(one.shape)) for one in (first, second))
    both = mine.followed_by(theirs, size)
    for robot in range(len(first)):
        assert models(both, robot) == (models(mine, robot) + models(theirs, robot))[:size]


@given(full_or_not, st.integers(0, 7))
def test_robots_take_the_models_of_one_library_or_the_other(
    full: tuple[list[list[bool]], list[list[bool]]], which: int
) -> None:
    first, second = (torch.tensor(one) for one in full)
    mine, theirs = (library_of(one, torch.randn(one.shape)) for one in (first, second))
    rows = torch.tensor([bool(which >> robot & 1) for robot in range(len(first))])
    chosen = either(rows, mine, theirs)
    for robot in range(len(first)):
        assert models(chosen, robot) == models(mine if rows[robot] else theirs, robot)
        assert models(either(rows, mine, None), robot) == (models(mine, robot) if rows[robot] else [])
        assert models(either(rows, None, theirs), robot) == ([] if rows[robot] else models(theirs, robot))


@pytest.mark.parametrize(
    ("own", "embedding", "old", "kept"),
    [
        (0.0, -9.0, [-99.0, -99.0], ["new", 0, 1]),  # a new one
        (0.0, -9.0, [-99.0, -2.0], ["new", 0]),  # as good as the second, and takes its place
        (0.0, -9.0, [-99.0, 2.0], [0, 1]),  # the second is better
        (0.0, -4.0, [-99.0, -99.0], [0, 1]),  # an embedding is as good
    ],
)
def test_model_is_kept_that_explained_what_nothing_else_did(
    own: float, embedding: float, old: list[float], kept: list[str | int]
) -> None:
    library = library_of(torch.tensor([[True, True]]), torch.tensor([old]))
    past = Memory(
        *[torch.ones(1, 1, 1)] * 3, torch.full((1, 1, 1), embedding), torch.full((1, 1), own), torch.ones(1, 1)
    )
    number, everyone = torch.full((1, 1), 77.0), torch.tensor([True])
    new = Library.of({"w": number}, number, torch.tensor([0]), past, everyone)
    found = enlarged(library, new, surprise=5.0, size=3)
    assert models(found, 0) == [77.0 if one == "new" else old[one] for one in kept]
    assert models(enlarged(library, new.only(~everyone[:, None]), surprise=5.0, size=3), 0) == old
