from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from famle_agent.transitions import HeldUniformPolicy, Transitions, collect

Array = npt.NDArray[Any]
LOW, HIGH = np.array([2.0, -6.0], dtype=np.float32), np.array([5.0, -4.0], dtype=np.float32)
FLOAT32 = st.floats(width=32, allow_nan=False, allow_infinity=False)


class Clock(gym.Env[Array, Array]):
    """Observes the episode and the step; its actions are far from [-1, 1]."""

    observation_space = spaces.Box(-np.inf, np.inf, (3,))
    action_space = spaces.Box(LOW, HIGH)

    def __init__(self, length: int = 4, terminates: bool = True, reuses: bool = False) -> None:
        self.length, self.terminates, self.reuses = length, terminates, reuses
        self.episode, self.seeds = -1, []
        self.buffer = np.zeros(3, dtype=np.float32)

    def observe(self) -> Array:
        self.buffer[:] = (self.episode, self.clock, self.np_random.random())
        return self.buffer if self.reuses else self.buffer.copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.episode, self.clock = self.episode + 1, 0
        return self.observe(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action)
        self.clock += 1
        over = self.clock == self.length
        return self.observe(), 10.0 * self.clock, over and self.terminates, over and not self.terminates, {}


def held(hold: int) -> Callable[..., HeldUniformPolicy]:
    return lambda space, rng: HeldUniformPolicy(space, hold, rng)


def collected(n: int = 9, seed: int = 0, hold: int = 1, envs: list[Clock] | None = None) -> Transitions:
    envs = envs or [Clock(), Clock()]
    return collect(envs, [f"situation {i}" for i in range(len(envs))], n, held(hold), seed)


def some_transitions(**changes: Any) -> Transitions:
    values = {
        "obs": np.zeros((2, 3, 4), np.float32),
        "action": np.zeros((2, 3, 1), np.float32),
        "reward": np.zeros((2, 3), np.float32),
        "next_obs": np.zeros((2, 3, 4), np.float32),
        "situations": ("intact", "broken"),
    }
    return Transitions(**{**values, **changes})


# --- collecting -------------------------------------------------------------------------------------------


def test_shapes_and_types() -> None:
    counts: list[int] = []
    data = collect([Clock(), Clock(), Clock()], ["a", "b", "c"], 7, held(2), 0, counts.append)
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


def test_actions_fill_the_action_space() -> None:
    action = collected(n=500, envs=[Clock()]).action[0]
    assert (action >= LOW).all()
    assert (action <= HIGH).all()
    np.testing.assert_allclose(action.min(axis=0), LOW, atol=0.05)
    np.testing.assert_allclose(action.max(axis=0), HIGH, atol=0.05)
    np.testing.assert_allclose(action.mean(axis=0), (LOW + HIGH) / 2, atol=0.15)


def test_drawn_action_is_not_shared() -> None:
    policy = HeldUniformPolicy(Clock.action_space, 3, np.random.default_rng(0))
    first = policy(np.zeros(3), True)
    original = first.copy()
    first += 1
    np.testing.assert_array_equal(policy(np.zeros(3), False), original)


# --- storing ----------------------------------------------------------------------------------------------


@st.composite
def any_transitions(draw: st.DrawFn) -> Transitions:
    N, n, obs_dim, action_dim = (draw(st.integers(1, 3)) for _ in range(4))

    def array(*shape: int) -> Array:
        return draw(npst.arrays(np.float32, shape, elements=FLOAT32))

    names = draw(st.lists(st.text(st.characters(exclude_categories=("C",))), min_size=N, max_size=N))
    return Transitions(array(N, n, obs_dim), array(N, n, action_dim), array(N, n), array(N, n, obs_dim), tuple(names))


@given(any_transitions())
def test_what_is_saved_is_loaded(tmp_path_factory: pytest.TempPathFactory, data: Transitions) -> None:
    path = tmp_path_factory.mktemp("transitions") / "data.npz"
    data.save(path)
    loaded = Transitions.load(path)
    assert loaded.situations == data.situations
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(data, name))
        assert getattr(loaded, name).dtype == np.float32
    assert [file.name for file in path.parent.iterdir()] == ["data.npz"]


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9, 0.99])
def test_truncated_file_is_refused(tmp_path: Path, part: float) -> None:
    path = tmp_path / "data.npz"
    collected().save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(ValueError, match="collect them again"):
        Transitions.load(path)


@given(st.data())
def test_damaged_file_is_refused_or_harmless(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path, original = tmp_path_factory.mktemp("transitions") / "data.npz", collected()
    original.save(path)
    content = bytearray(path.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    try:
        loaded = Transitions.load(path)
    except ValueError:
        return
    np.testing.assert_array_equal(loaded.obs, original.obs)
    np.testing.assert_array_equal(loaded.reward, original.reward)


def npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


GOOD = {name: getattr(some_transitions(), name) for name in ("obs", "action", "reward", "next_obs", "situations")}


@pytest.mark.parametrize(
    "content",
    [
        b"hello",
        npz(weights=np.ones(3)),
        npy(np.ones(3)),
        npz(**{**GOOD, "obs": np.array([{"a": 1}], dtype=object)}),
        npz(**{**GOOD, "obs": np.array(["a", "b"])}),
        npz(**{**GOOD, "situations": np.array("intact")}),
        npz(**{**GOOD, "reward": np.zeros((2, 4), np.float32)}),
        npz(**{**GOOD, "action": np.full((2, 3, 1), np.nan, np.float32)}),
    ],
    ids=["text", "other arrays", "one array", "pickle", "strings", "one situation", "shape", "NaN"],
)
def test_foreign_file_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "data.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"holds no transitions|expected|finite"):
        Transitions.load(tmp_path / "data.npz")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        Transitions.load(tmp_path / "data.npz")


def test_failed_save_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "data.npz"
    collected().save(path)
    before = path.read_bytes()

    def fail(file: Any, **_: Any) -> None:
        file.write(b"half of it")
        raise OSError("No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="No space left"):
        collected(seed=1).save(path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["data.npz"]


# --- what is refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"obs": np.zeros((2, 3), np.float32)}, "obs has shape"),
        ({"obs": np.zeros((3, 3, 4), np.float32)}, "obs has shape"),
        ({"action": np.zeros((2, 2, 1), np.float32)}, "action has shape"),
        ({"reward": np.zeros((2, 3, 1), np.float32)}, "reward has shape"),
        ({"next_obs": np.zeros((2, 3, 5), np.float32)}, "must have the same shape"),
        ({"situations": ("intact",)}, "obs has shape"),
        ({"next_obs": np.full((2, 3, 4), np.nan, np.float32)}, "next_obs holds values that are not finite"),
        ({"reward": np.full((2, 3), np.inf, np.float32)}, "reward holds values that are not finite"),
    ],
)
def test_transitions_that_do_not_fit_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        some_transitions(**changes)


def test_robot_that_gives_no_numbers_is_refused() -> None:
    class Broken(Clock):
        def observe(self) -> Array:
            return super().observe() * (np.nan if self.clock == 3 else 1.0)

    with pytest.raises(ValueError, match="not finite"):
        collected(envs=[Broken()])


def test_transitions_are_frozen() -> None:
    data = some_transitions()
    with pytest.raises(AttributeError):
        data.obs = data.next_obs  # type: ignore[misc]
    assert replace(data, situations=("a", "b")).situations == ("a", "b")
