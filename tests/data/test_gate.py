"""What environments and users return is checked and copied before anything rests on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper

from famle_agent import FAMLE, FAMLEWrapper, Transitions
from famle_agent.data import gate
from famle_agent.data.gate import check_action, check_observation
from famle_agent.training.policy_search import PolicySearch, Search
from tests.clock import Clock, collected

Array = npt.NDArray[Any]
MakeEnv = Callable[..., gym.Env[Any, Any]]
SPACE = spaces.Box(-np.inf, np.inf, (3,))


@given(
    st.sampled_from([np.float16, np.float32, np.float64, np.int32, np.uint8, np.bool_]).flatmap(
        lambda dtype: (
            npst.arrays(dtype, (2, 3), elements={"max_value": 100} if dtype != np.bool_ else None)
            if np.dtype(dtype).kind not in "f"
            else npst.arrays(dtype, (2, 3), elements={"min_value": -100, "max_value": 100})
        )
    ),
    st.sampled_from(["as it is", "reversed", "every other", "read-only", "list", "tensor"]),
)
def test_numbers_enter_as_float32_of_their_own(values: Array, how: str) -> None:
    wide = np.repeat(values, 2, axis=1)
    given_ = {
        "as it is": lambda: values,
        "reversed": lambda: values[::-1, ::-1][::-1, ::-1],
        "every other": lambda: wide[:, ::2],
        "read-only": lambda: (values.setflags(write=False), values)[1],
        "list": values.tolist,
        "tensor": lambda: torch.from_numpy(values.copy()),
    }[how]()
    array = check_observation(given_, SPACE)
    assert array.dtype == np.float32
    assert array.flags.writeable
    assert array.flags.owndata
    np.testing.assert_array_equal(array, values.astype(np.float32))
    if isinstance(given_, np.ndarray):
        assert not np.shares_memory(array, given_)


@pytest.mark.parametrize(
    "values",
    [
        np.array([0.0, np.nan, 0.0]),
        np.array([0.0, np.inf, 0.0]),
        np.array([0.0, 1e39, 0.0]),  # beyond float32
        np.zeros(2),
        np.zeros((1, 1, 3)),
        np.zeros(3, dtype=complex),
        np.array(["1", "2", "3"]),
        [0.0, None, 0.0],
        [[0.0], [0.0, 1.0], []],
        {"obs": 1},
        (np.zeros(3), {}),
    ],
)
def test_what_is_no_observation_or_action_is_refused(values: Any) -> None:
    for check in (check_observation, check_action):
        with pytest.raises(ValueError, match=r"must|holds|Got"):
            check(values, SPACE)


# --- one step -------------------------------------------------------------------------------------------------


class Returning(gym.Env[Any, Any]):
    """Returns from each step what it was told to; beyond that it stands still."""

    observation_space = spaces.Box(-10, 10, (2,))
    action_space = spaces.Box(-1, 1, (1,))

    def __init__(self, **returned: Any) -> None:
        good: dict[str, Any] = {"obs": np.zeros(2, np.float32), "reward": 0.5, "terminated": False, "truncated": False}
        self.returned = {**good, "info": {}, **returned}
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return tuple(self.returned.values())


@pytest.mark.parametrize(
    ("reward", "expected"),
    [
        (2, 2.0),
        (np.float32(0.5), 0.5),
        (np.array([0.5]), 0.5),
        (np.array(0.5), 0.5),
        (np.int64(3), 3.0),
        (torch.tensor(0.5), 0.5),
        (np.array([[1.5]]), 1.5),
        (True, 1.0),
    ],
)
def test_reward_becomes_a_float(reward: Any, expected: float) -> None:
    step = gate.step(Returning(reward=reward), np.zeros(1))
    assert type(step.reward) is float
    assert step.reward == expected


@pytest.mark.parametrize("flag", [True, np.bool_(True), np.array([True]), 1, torch.tensor(True)])
def test_flags_become_bool(flag: Any) -> None:
    step = gate.step(Returning(terminated=flag), np.zeros(1))
    assert step.terminated is True
    assert step.truncated is False


WRONG: dict[str, Any] = {
    "obs": [np.zeros(3), np.array([np.nan, 0.0]), None, np.zeros((1, 2))],
    "reward": [np.nan, np.inf, np.zeros(2), None, "1"],
    "terminated": [0.5, None, np.array([True, False]), "no"],
    "truncated": [2],
    "info": [None, [], 3],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in WRONG.items() for value in values])
def test_step_of_another_form_is_refused_at_once_in_simulation(name: str, value: Any) -> None:
    env = Returning(**{name: value})
    with pytest.raises(ValueError, match=r"must|holds"):
        collected(n=50, envs=[env])
    assert env.steps == 1
    env = Returning(**{name: value})
    search = Search(PolicySearch(40, hidden=(4,), random_steps=5), [env], ["a"], 0)
    with pytest.raises(ValueError, match=r"must|holds"):
        list(search.run())
    assert env.steps == 1


def test_step_of_four_values_is_refused() -> None:
    class Old(Returning):
        def step(self, action: Any) -> Any:
            return super().step(action)[:4]

    with pytest.raises(ValueError, match=r"must return \(obs, reward, terminated, truncated, info\), got 4 values"):
        gate.step(Old(), np.zeros(1))


def test_reset_without_info_is_refused() -> None:
    class Old(Returning):
        def reset(self, **_: Any) -> Any:
            return np.zeros(2, np.float32)

    with pytest.raises(ValueError, match=r"must return \(obs, info\), got ndarray"):
        gate.reset(Old())


# --- the action that was commanded ----------------------------------------------------------------------------


class ScalesInPlace(gym.Wrapper[Any, Any, Any, Any]):
    def step(self, action: Any) -> Any:
        action *= 0.5
        action += 0.1
        return self.env.step(action)


def test_simulation_remembers_the_action_that_was_sent() -> None:
    class Scales(Clock):
        def step(self, action: Any) -> Any:
            returned = super().step(action)
            action *= 5.0
            return returned

    np.testing.assert_array_equal(collected(envs=[Scales()], hold=3).action, collected(envs=[Clock()], hold=3).action)


def test_wrapper_remembers_the_action_that_was_sent(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(ScalesInPlace(make_env()), quick_agent)
    env.reset(seed=0)
    action = np.linspace(-1, 1, 5, dtype=np.float32)
    env.step(action)
    np.testing.assert_array_equal(action, np.linspace(-1, 1, 5, dtype=np.float32))
    np.testing.assert_array_equal(quick_agent.state_of(1).memory.action[0, -1], action)


def test_action_that_is_none_moves_nothing(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    moved: list[Any] = []

    class Counting(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            moved.append(action)
            return self.env.step(action)

    env = FAMLEWrapper(Counting(make_env()), quick_agent)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action holds NaN"):
        env.step(np.full(5, np.nan))
    assert moved == []


# --- vector environments --------------------------------------------------------------------------------------


class OneBuffer(VecEnvWrapper):
    """Returns the same array from every step, or a view of it that is made in another way."""

    def __init__(self, venv: Any, view: Callable[[Array], Array] = lambda buffer: buffer) -> None:
        super().__init__(venv)
        self.view, self.buffer = view, np.zeros((venv.num_envs, *venv.observation_space.shape), np.float32)

    def reset(self) -> Any:
        self.buffer[:] = self.venv.reset()
        return self.view(self.buffer)

    def step_wait(self) -> Any:
        self.buffer[:], rewards, dones, infos = self.venv.step_wait()
        return self.view(self.buffer), rewards, dones, infos


def read_only(buffer: Array) -> Array:
    view = buffer.view()
    view.flags.writeable = False
    return view


VIEWS = {"same": lambda b: b, "reversed twice": lambda b: b[::-1][::-1], "reversed": lambda b: b[::-1]}


@pytest.mark.filterwarnings("error:.*not writable")
@pytest.mark.parametrize("view", [*VIEWS.values(), read_only, np.asfortranarray], ids=[*VIEWS, "read-only", "Fortran"])
def test_buffers_of_a_vec_env_are_copied(quick_agent: FAMLE, make_env: MakeEnv, view: Callable[[Array], Array]) -> None:
    quick_agent.set_env(OneBuffer(DummyVecEnv([make_env]), view))
    quick_agent.learn(10)
    memory = quick_agent.state_of(1).memory
    assert memory.seen == 10
    assert (memory.obs != memory.next_obs).any(dim=-1)[0, -10:].all()
    torch.testing.assert_close(memory.obs[0, -9:], memory.next_obs[0, -10:-1])


@pytest.mark.parametrize(
    "broken",
    [
        lambda obs, rewards, dones, infos: (obs[:, :3], rewards, dones, infos),
        lambda obs, rewards, dones, infos: (obs, rewards[:, None], dones, infos),
        lambda obs, rewards, dones, infos: (obs, rewards, dones[:0], infos),
        lambda obs, rewards, dones, infos: (obs, rewards, dones, []),
    ],
    ids=["dimensions", "column", "dones", "infos"],
)
def test_vec_env_that_returns_something_else_is_refused(
    quick_agent: FAMLE, make_env: MakeEnv, broken: Callable[..., Any]
) -> None:
    class Broken(VecEnvWrapper):
        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            return broken(*self.venv.step_wait())

    quick_agent.set_env(Broken(DummyVecEnv([make_env])))
    with pytest.raises(ValueError, match=r"must|holds"):
        quick_agent.learn(5)


# --- transitions ----------------------------------------------------------------------------------------------


@given(st.sampled_from([np.float64, np.float16, np.int64]))
def test_transitions_are_copies_in_single_precision(dtype: Any) -> None:
    obs, reward = np.ones((1, 3, 2), dtype=dtype), np.ones((1, 3), dtype=dtype)
    data = Transitions(obs, obs, reward, obs, ("a",), terminated=np.array([[0, 0, 1]]))  # type: ignore[arg-type]
    obs[:], reward[:] = 7, 7
    for name in ("obs", "action", "reward", "next_obs"):
        assert getattr(data, name).dtype == np.float32
        assert (getattr(data, name) == 1.0).all()
    assert data.ended.dtype == np.bool_
    with pytest.raises(ValueError, match="True or False"):
        Transitions(obs, obs, reward, obs, ("a",), terminated=np.array([[0, 0, 2]]))  # type: ignore[arg-type]
