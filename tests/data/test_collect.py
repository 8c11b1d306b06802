from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from joblib import parallel_config

from famle_agent.data.collect import collect
from famle_agent.data.policies import make_held_uniform
from famle_agent.data.transitions import Transitions
from tests.clock import HIGH, LOW, Clock, collected

Array = npt.NDArray[Any]


def assert_equal(one: Transitions, other: Transitions) -> None:
    assert one.situations == other.situations
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


# --- collecting -------------------------------------------------------------------------------------------


def test_shapes_and_types() -> None:
    counts: list[int] = []
    data = collect([Clock(), Clock, Clock()], ["a", "b", "c"], 7, make_held_uniform(2), 0, counts.append)
    assert data.obs.shape == data.next_obs.shape == (3, 7, 3)
    assert data.action.shape == (3, 7, 2)
    assert data.reward.shape == (3, 7)
    assert {getattr(data, name).dtype for name in ("obs", "action", "reward", "next_obs")} == {np.dtype(np.float32)}
    assert data.situations == ("a", "b", "c")
    assert counts == [7, 7, 7]


@pytest.mark.parametrize("terminates", [True, False])
def test_no_transition_crosses_a_reset(terminates: bool) -> None:
    data = collected(n=11, envs=[Clock(4, terminates)])
    episode, step = data.obs[0, :, 0], data.obs[0, :, 1]
    np.testing.assert_array_equal(data.next_obs[0, :, 0], episode)
    np.testing.assert_array_equal(data.next_obs[0, :, 1], step + 1)
    np.testing.assert_array_equal(data.reward[0], 10 * (step + 1))
    np.testing.assert_array_equal(episode, np.arange(11) // 4)
    inside = episode[1:] == episode[:-1]
    np.testing.assert_array_equal(data.next_obs[0, :-1][inside], data.obs[0, 1:][inside])


def test_seed_decides_everything() -> None:
    one, same, other = collected(seed=0), collected(seed=0), collected(seed=1)
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert not np.array_equal(one.action, other.action)
    assert not np.array_equal(one.obs, other.obs)  # the environments are seeded too
    assert not np.array_equal(one.action[0], one.action[1])
    assert not np.array_equal(one.obs[0], one.obs[1])


def test_environments_are_seeded_once() -> None:
    env = Clock()
    collected(n=9, envs=[env])
    assert [seed is None for seed in env.seeds] == [False, True, True]


def test_environment_may_reuse_its_observation() -> None:
    fresh, reused = collected(envs=[Clock()]), collected(envs=[Clock(reuses=True)])
    np.testing.assert_array_equal(fresh.obs, reused.obs)
    np.testing.assert_array_equal(fresh.next_obs, reused.next_obs)


@given(st.integers(1, 6), st.integers(1, 7))
def test_actions_are_held_and_drawn_anew_when_an_episode_begins(hold: int, length: int) -> None:
    data = collected(n=20, hold=hold, envs=[Clock(length)])
    step = data.obs[0, :, 1]
    for i in range(1, 20):
        redrawn = int(step[i]) % hold == 0  # an episode begins with step 0
        assert np.array_equal(data.action[0, i], data.action[0, i - 1]) == (not redrawn)


@given(st.integers(1, 9), st.integers(0, 9))
def test_episode_ends_where_the_environment_or_its_length_ends_it(own: int, length: int) -> None:
    data = collected(n=20, envs=[Clock(own)], episode_length=length)
    shorter = min(own, length) if length else own
    assert data.obs[0, :, 1].tolist() == [i % shorter for i in range(20)]
    assert data.obs[0, :, 0].tolist() == [i // shorter for i in range(20)]


def test_actions_fill_the_action_space() -> None:
    action = collected(n=500, envs=[Clock()]).action[0]
    assert (action >= LOW).all()
    assert (action <= HIGH).all()
    np.testing.assert_allclose(action.min(axis=0), LOW, atol=0.05)
    np.testing.assert_allclose(action.max(axis=0), HIGH, atol=0.05)
    np.testing.assert_allclose(action.mean(axis=0), (LOW + HIGH) / 2, atol=0.15)


# --- who makes and who closes an environment ----------------------------------------------------------------


class Counted(Clock):
    """Remembers what happened to all of its kind."""

    made: list[Counted]

    def __init__(self) -> None:
        super().__init__()
        self.closed = False
        self.made.append(self)

    def close(self) -> None:
        self.closed = True


@pytest.fixture(autouse=True)
def none_made() -> None:
    Counted.made = []


def test_what_is_made_here_is_closed_here_and_what_is_given_stays_open() -> None:
    own = Counted()
    collected(envs=[Counted, own, Counted])
    assert [env is own or env.closed for env in Counted.made] == [True] * 3
    assert not own.closed
    assert sorted(len(env.seeds) for env in Counted.made) == [3, 3, 3]  # each was used once


def test_environment_is_closed_where_its_policy_fails() -> None:
    class FailingError(Exception):
        pass

    def fail(*_: Any) -> Any:
        raise FailingError

    with pytest.raises(FailingError):
        collect([Counted], ["a"], 3, lambda env, situation, rng: fail, 0)
    assert [env.closed for env in Counted.made] == [True]


def test_factories_and_environments_collect_the_same_and_in_order() -> None:
    assert_equal(collected(envs=[Clock(), Clock(), Clock()]), collected(envs=[Clock, Clock(), Clock]))


def test_policy_knows_the_environment_and_its_situation() -> None:
    envs, seen = [Clock(3), Clock(4)], []

    def make_policy(env: Clock, situation: int, rng: np.random.Generator) -> Callable[[Array, bool], Array]:
        seen.append((env, situation))
        return lambda obs, episode_start: np.array([3.0, -5.0 if episode_start else -4.5], np.float32)

    with pytest.raises(AssertionError):  # of the clock, that an action is none of its own
        collect(envs, ["a", "b"], 5, lambda *_: lambda *_: np.zeros(2), 0)
    data = collect(envs, ["a", "b"], 5, make_policy, 0)
    assert seen == [(envs[0], 0), (envs[1], 1)]
    np.testing.assert_array_equal(data.action[0, :, 1], [-5.0, -4.5, -4.5, -5.0, -4.5])
    np.testing.assert_array_equal(data.action[1, :, 1], [-5.0, -4.5, -4.5, -4.5, -5.0])


@pytest.mark.slow
def test_processes_collect_what_one_would() -> None:
    counts: list[int] = []
    envs = [partial(Clock, 3), Clock(5), partial(Clock, 4)]
    parallel = collected(n=12, envs=envs, n_jobs=2, callback=counts.append)
    assert counts == [12, 12, 12]
    assert_equal(parallel, collected(n=12, envs=[partial(Clock, 3), Clock(5), partial(Clock, 4)]))


@pytest.mark.parametrize("backend", ["threading", "sequential"])
def test_collecting_in_this_process_keeps_the_number_of_threads(backend: str) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with parallel_config(backend):
            collected(envs=[partial(Clock, 3), partial(Clock, 5)], n_jobs=2)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


# --- several situations side by side ------------------------------------------------------------------------


@dataclass(frozen=True)
class InOrder:
    """Acts by how many robots are beside one, and by a number that all of them share."""

    batch_size: int = 2

    def __call__(self, envs: Sequence[Any], situations: Sequence[int], rng: np.random.Generator) -> Any:
        def act(obs: Array, begins: Array) -> Array:
            assert len(obs) == len(begins) == len(situations) <= self.batch_size
            assert (begins == (obs[:, 1] == 0)).all()  # of each robot's own episode
            low, share = LOW + 0.5 * begins[:, None], rng.uniform(0.0, 0.5) + 0.1 * len(obs)
            return np.stack([low[i] + share * np.array([1.0, 0.1 * c]) for i, c in enumerate(situations)], dtype="f")

        return act


LENGTHS = [3, 5, 4, 7, 2]
CLOCKS = [partial(Clock, length) for length in LENGTHS]
CALLED = [f"clock {length}" for length in LENGTHS]


def test_each_robot_of_a_batch_lives_its_own_episodes() -> None:
    counts: list[int] = []
    data = collect(CLOCKS, CALLED, 11, InOrder(3), 0, counts.append)
    assert counts == [11] * 5
    assert data.situations == tuple(CALLED)
    for i, length in enumerate(LENGTHS):
        assert data.obs[i, :, 1].tolist() == [step % length for step in range(11)]
        assert data.obs[i, :, 0].tolist() == [step // length for step in range(11)]
    alone = collect(CLOCKS, CALLED, 11, InOrder(1), 0)
    np.testing.assert_array_equal(data.obs, alone.obs)  # each has the chance of its own environment


def test_environments_that_exist_and_factories_are_put_into_the_same_batches() -> None:
    made = [Clock(length) if i in (1, 4) else CLOCKS[i] for i, length in enumerate(LENGTHS)]
    assert_equal(collect(made, CALLED, 9, InOrder(), 0), collect(CLOCKS, CALLED, 9, InOrder(), 0))


@pytest.mark.slow
def test_processes_collect_batches_as_one_would() -> None:
    assert_equal(collect(CLOCKS, CALLED, 9, InOrder(), 0, n_jobs=2), collect(CLOCKS, CALLED, 9, InOrder(), 0))


@given(st.sets(st.integers(0, 4)))
def test_batch_of_which_some_are_missing_is_collected_again_to_the_same(missing: set[int]) -> None:
    with TemporaryDirectory() as name:
        folder = Path(name)
        whole = collect(CLOCKS, CALLED, 6, InOrder(), 0, folder=folder)
        files = [folder / f"situation-00{i}.npz" for i in range(5)]
        before = [file.stat().st_mtime_ns for file in files]
        for i in missing:
            files[i].unlink()
        assert_equal(collect(CLOCKS, CALLED, 6, InOrder(), 0, folder=folder), whole)
        assert all(files[i].stat().st_mtime_ns == before[i] for i in range(5) if i not in missing)
        assert all(file.exists() for file in files)


# --- environments that fail ---------------------------------------------------------------------------------


class Failing(Clock):
    """Fails in the second step of its second episode, in one of several ways."""

    def __init__(self, how: str) -> None:
        super().__init__()
        self.how = how

    def step(self, action: Array) -> Any:
        stepped = super().step(action)
        if (self.episode, self.clock) != (1, 2):
            return stepped
        if self.how == "raises":
            raise ZeroDivisionError("no mass")
        obs, reward, *others = stepped
        return {
            "no observation": (obs * np.nan, reward, *others),
            "no reward": (obs, "much", *others),
            "no step": (obs, reward),
            "a reset": (self.reset()[0], reward, *others),
        }[self.how]


@pytest.mark.parametrize("how", ["raises", "no observation", "no reward", "no step", "a reset"])
@pytest.mark.parametrize("batch_size", [1, 3])
def test_failing_environment_names_its_situation_and_all_are_closed(how: str, batch_size: int, tmp_path: Path) -> None:
    makers = [Counted, partial(Failing, how), Counted]
    with pytest.raises((ZeroDivisionError, ValueError), match="in the situation 'bent'") as raised:
        collect(makers, ["straight", "bent", "short"], 9, InOrder(batch_size), 0, folder=tmp_path)
    assert isinstance(raised.value, ZeroDivisionError) == (how == "raises")
    assert all(env.closed for env in Counted.made)
    assert sorted(file.name for file in tmp_path.iterdir()) == (["situation-000.npz"] if batch_size == 1 else [])


def test_environment_that_cannot_be_made_names_its_situation() -> None:
    with pytest.raises(ConnectionError, match="simulator is gone\nIt was raised in the situation 'bent'"):
        collect([Counted, broken], ["straight", "bent"], 9, InOrder(), 0)
    assert [env.closed for env in Counted.made] == [True]


# --- a folder -----------------------------------------------------------------------------------------------


def broken() -> Clock:
    raise ConnectionError("the simulator is gone")


def test_folder_keeps_what_was_collected_before_a_failure(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "folder"
    with pytest.raises(ConnectionError):
        collected(envs=[Counted, broken, Counted], folder=folder)
    assert [file.name for file in folder.iterdir()] == ["situation-000.npz"]
    assert len(Counted.made) == 1
    counts: list[int] = []
    resumed = collected(envs=[broken, Counted, Counted], folder=folder, callback=counts.append)
    assert len(Counted.made) == 3  # the first situation was not simulated again
    assert counts == [9, 9, 9]
    assert_equal(resumed, collected(envs=[Clock(), Clock(), Clock()]))
    assert sorted(file.name for file in folder.iterdir()) == [f"situation-00{i}.npz" for i in range(3)]
    assert_equal(collected(envs=[broken, broken, broken], folder=folder), resumed)


def test_situation_that_stops_halfway_leaves_no_file(tmp_path: Path) -> None:
    class Stops(Clock):
        def step(self, action: Array) -> Any:
            if self.clock == 2:
                raise KeyboardInterrupt
            return super().step(action)

    with pytest.raises(KeyboardInterrupt):
        collected(envs=[Stops()], folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_folder_of_another_number_or_situation_is_refused(tmp_path: Path) -> None:
    collected(n=9, folder=tmp_path)
    with pytest.raises(
        ValueError, match=r"9 transitions of 'situation 0' instead of 5.*Give another folder, or delete"
    ):
        collected(n=5, folder=tmp_path)
    with pytest.raises(ValueError, match=r"of 'situation 0' instead of 9 of 'bent'.*Give another folder, or delete"):
        collect([Clock(), Clock()], ["bent", "situation 1"], 9, make_held_uniform(1), 0, folder=tmp_path)


def test_damaged_file_in_the_folder_is_named(tmp_path: Path) -> None:
    collected(folder=tmp_path)
    path = tmp_path / "situation-001.npz"
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(ValueError, match=r"situation-001\.npz holds no transitions, or not all of them"):
        collected(folder=tmp_path)


@pytest.mark.parametrize("terminates", [True, False])
def test_ends_of_episodes_are_kept(terminates: bool, tmp_path: Path) -> None:
    data = collected(n=11, envs=[Clock(4, terminates), Clock(100, terminates)])
    expected = np.zeros((2, 11), dtype=bool)
    expected[0, 3::4] = terminates  # a time limit is no end
    np.testing.assert_array_equal(data.ended, expected)
    data.save(tmp_path / "data.npz")
    np.testing.assert_array_equal(Transitions.load(tmp_path / "data.npz").ended, expected)
    np.testing.assert_array_equal(data.followed_by(data).ended, np.concatenate([expected, expected], axis=1))
