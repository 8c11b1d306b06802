"""A robot that fails ends its own episode, and says so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from famle_agent import TruncateOnError
from famle_agent.data.wrappers import robot_layers

Array = npt.NDArray[Any]
NOTHING = np.zeros(1, np.float32)


class Walker(gym.Env[Any, Any]):
    """Observes its step, and does in its third what a test wants.

    Args:
        third: Returns what that step returns.
        resets: How often it can be reset.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (1,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, third: Callable[[], Any] | None = None, resets: int = 100) -> None:
        self.third, self.left, self.clock, self.steps = third, resets, 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        if not self.left:
            raise TimeoutError("nobody answers")
        self.left, self.clock = self.left - 1, 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        self.clock, self.steps = self.clock + 1, self.steps + 1
        if self.clock == 3 and self.third is not None:
            return self.third()
        return np.full(1, self.clock, np.float32), 1.0, False, False, {"battery": 1.0}


def stop() -> Any:
    raise ConnectionError("the cable is loose")


def interrupt() -> Any:
    raise KeyboardInterrupt


def run(env: gym.Env[Any, Any], steps: int) -> list[Any]:
    return [env.step(NOTHING) for _ in range(steps)]


GARBAGE: dict[str, Any] = {
    "other shape": (np.zeros(2, np.float32), 0.0, False, False, {}),
    "text": ("far away", 0.0, False, False, {}),
    "two rewards": (np.zeros(1, np.float32), [0.0, 0.0], False, False, {}),
    "no flag": (np.zeros(1, np.float32), 0.0, None, False, {}),
    "four values": (np.zeros(1, np.float32), 0.0, False, {}),
    "nothing": None,
}


def test_robot_that_works_is_what_it_is() -> None:
    env = TruncateOnError(Walker())
    assert env.reset(seed=0)[1] == {}
    obs, *rest = run(env, 2)[1]
    assert obs.tolist() == [2.0]
    assert rest == [1.0, False, False, {"battery": 1.0}]
    assert env.errors == 0
    assert not robot_layers(env, "clock")


@pytest.mark.parametrize(
    "third", [stop, *(lambda value=value: value for value in GARBAGE.values())], ids=["stop", *GARBAGE]
)
def test_failure_ends_the_episode(third: Callable[[], Any]) -> None:
    env = TruncateOnError(Walker(third))
    env.reset(seed=0)
    run(env, 2)
    with pytest.warns(UserWarning, match=r"step\(\) of <Walker instance> failed"):
        obs, reward, terminated, truncated, info = env.step(NOTHING)
    assert np.isnan(obs).all()
    assert obs.dtype == np.float32
    assert (reward, terminated, truncated, env.errors) == (0.0, False, True, 1)
    assert info["error"].startswith("ConnectionError: the cable" if third is stop else "ValueError: ")
    assert env.reset()[0].tolist() == [0.0]
    assert run(env, 2)[1][0].tolist() == [2.0]


@pytest.mark.filterwarnings("ignore:.*failed")
def test_robot_that_cannot_be_reset_is_left_alone_until_the_next_reset() -> None:
    env = TruncateOnError(Walker(stop, resets=1))
    env.reset(seed=0)
    run(env, 3)
    obs, info = env.reset()
    assert np.isnan(obs).all()
    assert info["error"] == "TimeoutError: nobody answers"
    for obs, reward, terminated, truncated, info in run(env, 5):
        assert np.isnan(obs).all()
        assert (reward, terminated, truncated, info["error"]) == (0.0, False, False, "TimeoutError: nobody answers")
    assert (env.errors, env.unwrapped.steps) == (2, 3)
    env.unwrapped.left = 1
    assert env.reset()[0].tolist() == [0.0]
    assert run(env, 1)[0][0].tolist() == [1.0]


def test_missing_observation_is_no_failure() -> None:
    env = TruncateOnError(Walker(lambda: (None, 1.0, False, False, {})))
    env.reset()
    obs, _, _, truncated, _ = run(env, 3)[2]
    assert np.isnan(obs).all()
    assert (truncated, env.errors) == (False, 0)


def test_interrupt_is_not_caught() -> None:
    env = TruncateOnError(Walker(interrupt))
    env.reset()
    with pytest.raises(KeyboardInterrupt):
        run(env, 3)


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.Box(0, 255, (1,), np.uint8)])
def test_observations_without_nan_are_refused(space: gym.Space[Any]) -> None:
    env = Walker()
    env.observation_space = space  # type: ignore[assignment]
    with pytest.raises(ValueError, match="Box of floats"):
        TruncateOnError(env)


@pytest.mark.filterwarnings("ignore:.*failed")
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_others_go_on_in_vector_environments_of_gymnasium(mode: AutoresetMode) -> None:
    envs = gym.vector.SyncVectorEnv([Walker, lambda: TruncateOnError(Walker(stop))], autoreset_mode=mode)
    envs.reset(seed=0)
    seen = [envs.step(np.zeros((2, 1), np.float32))[0] for _ in range(5)]
    assert [obs[0, 0] for obs in seen] == [1.0, 2.0, 3.0, 4.0, 5.0]
    expected = [1.0, 2.0, np.nan, 0.0, 1.0] if mode is AutoresetMode.NEXT_STEP else [1.0, 2.0, 0.0, 1.0, 2.0]
    np.testing.assert_array_equal([obs[1, 0] for obs in seen], expected)


@pytest.mark.filterwarnings("ignore:.*failed")
@pytest.mark.parametrize("kind", [DummyVecEnv, pytest.param(SubprocVecEnv, marks=pytest.mark.slow)])
def test_others_go_on_in_vector_environments_of_stable_baselines(kind: type[DummyVecEnv | SubprocVecEnv]) -> None:
    envs = kind([lambda third=third: Monitor(TruncateOnError(Walker(third))) for third in (None, stop)])
    envs.reset()
    seen, dones, infos = [], [], []
    for _ in range(4):
        obs, _, done, info = envs.step(np.zeros((2, 1), np.float32))
        seen.append(obs[:, 0].tolist())
        dones.append(done.tolist())
        infos.append(info[1])
    assert seen == [[1.0, 1.0], [2.0, 2.0], [3.0, 0.0], [4.0, 1.0]]
    assert dones[2] == [False, True]
    assert infos[2]["error"] == "ConnectionError: the cable is loose"
    assert np.isnan(infos[2]["terminal_observation"]).all()
    assert envs.get_attr("errors") == [0, 1]
    envs.close()
