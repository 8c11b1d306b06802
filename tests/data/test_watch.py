"""No transition is learnt across what was not one step."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import Tensor

from famle_agent import FAMLE, FAMLEWrapper, OnlineState
from famle_agent.data.watch import VecWatch, Watch
from famle_agent.training.policy_search import PolicySearch, Search
from tests.clock import Clock, collected

Array = npt.NDArray[Any]
MakeEnv = Callable[..., gym.Env[Any, Any]]
NOTHING = np.zeros(1, np.float32)


class Counter(gym.Env[Any, Any]):
    """Observes the number of its episode, which lies far from any other, and of its step."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, length: int = 1000) -> None:
        self.length, self.episode, self.fails_at, self.fails_after_moving = length, 0, -1, False
        self.hides_at = -1

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.episode, self.clock = self.episode + 1, 0
        return self.observe(), {}

    def observe(self) -> Array:
        hidden = np.nan if self.clock == self.hides_at else 0.0
        return np.array([100 * self.episode, self.clock + hidden], np.float32)

    def step(self, action: Any) -> Any:
        if self.clock == self.fails_at:
            self.fails_at = -1
            self.clock += self.fails_after_moving
            raise ConnectionError("the cable is loose")
        self.clock += 1
        return self.observe(), 0.0, False, self.clock >= self.length, {}


def counting_agent() -> FAMLE:
    settings = {"transitions_per_situation": 20, "hidden": (4,), "candidates": 2, "planner_iterations": 1, "horizon": 2}
    agent = FAMLE(
        Counter(), reward_fn=lambda o, a, n: n[..., 0], policy_steps=0, joint_iterations=1, device="cpu", **settings
    )
    agent.meta_learn([Counter], check=False)
    return agent


def assert_single_steps(agent: FAMLE, n: int, robots: int = 1, state: OnlineState | None = None) -> None:
    """Each remembered transition is one step of one episode, and there are n of each robot."""
    memory = (state or agent.state_of(robots)).memory
    for robot in range(robots):
        kept = memory.weight[robot] > 0
        before, after = memory.obs[robot, kept], memory.next_obs[robot, kept]
        torch.testing.assert_close(after - before, torch.tensor([[0.0, 1.0]]).expand(len(before), 2))
        assert len(before) == n


@pytest.fixture
def agent() -> FAMLE:
    return counting_agent()


# --- the wrapper ----------------------------------------------------------------------------------------------


@given(st.integers(1, 5), st.integers(1, 20))
def test_episodes_that_begin_by_themselves(length: int, steps: int) -> None:
    agent = counting_agent()
    env = FAMLEWrapper(gym.wrappers.Autoreset(Counter(length)), agent)
    env.reset(seed=0)
    for _ in range(steps):
        env.step(NOTHING)
    assert_single_steps(agent, steps - steps // (length + 1))  # each episode ends with a step that is none


@pytest.mark.parametrize("tells", ["final_obs", "terminal_observation", ""])
def test_environment_that_resets_itself_within_a_step(agent: FAMLE, tells: str) -> None:
    class SameStep(Counter):
        def step(self, action: Any) -> Any:
            obs, reward, terminated, truncated, info = super().step(action)
            if truncated:
                info = {tells: obs} if tells else {}
                obs, _ = self.reset()
            return obs, reward, terminated, truncated, info

    env = FAMLEWrapper(SameStep(3), agent)
    env.reset()
    for _ in range(7):
        env.step(NOTHING)
    assert_single_steps(agent, 7 if tells else 5)


def test_plan_is_void_where_the_robot_was_reset(agent: FAMLE) -> None:
    env = FAMLEWrapper(gym.wrappers.Autoreset(Counter(2)), agent)
    obs, _ = env.reset()
    for _ in range(2):
        obs, *_ = env.step(NOTHING)
    agent.predict(obs)
    assert agent.state_of(1).plan.any()
    env.step(NOTHING)
    assert not agent.state_of(1).plan.any()


MOVES: dict[str, Callable[[gym.Env[Any, Any]], Any]] = {
    "reset": lambda env: env.reset(),
    "reset of the robot": lambda env: env.unwrapped.reset(),
    "step": lambda env: env.step(NOTHING),
    "episode": lambda env: [env.reset(), env.step(NOTHING), env.step(NOTHING)],
}


@pytest.mark.parametrize("move", MOVES.values(), ids=MOVES.keys())
@pytest.mark.parametrize("wrapped", [False, True])
def test_robot_that_somebody_else_moves(agent: FAMLE, move: Callable[[Any], Any], wrapped: bool) -> None:
    inner: Any = gym.wrappers.TimeLimit(Counter(), 1000) if wrapped else Counter()
    env = FAMLEWrapper(inner, agent)
    env.reset()
    for _ in range(3):
        env.step(NOTHING)
    move(inner)
    for _ in range(3):
        env.step(NOTHING)
    assert_single_steps(agent, 5)


@pytest.mark.parametrize("moves", [False, True])
def test_step_that_failed_is_not_learnt_from(agent: FAMLE, moves: bool) -> None:
    robot = Counter()
    env = FAMLEWrapper(robot, agent)
    env.reset()
    env.step(NOTHING)
    robot.fails_at, robot.fails_after_moving = 1, moves
    with pytest.raises(ConnectionError):
        env.step(NOTHING)
    for _ in range(3):
        env.step(NOTHING)
    assert_single_steps(agent, 3)


def test_observation_that_was_refused_begins_nothing(agent: FAMLE) -> None:
    robot = Counter()
    robot.hides_at = 3
    env = FAMLEWrapper(robot, agent)
    env.reset()
    for _ in range(6):
        env.step(NOTHING)
    assert_single_steps(agent, 4)


def test_action_that_was_refused_costs_nothing(agent: FAMLE) -> None:
    env = FAMLEWrapper(Counter(), agent)
    env.reset()
    for _ in range(2):
        env.step(NOTHING)
        with pytest.raises(ValueError, match="action"):
            env.step(np.array([np.nan]))
    assert_single_steps(agent, 2)


def test_watched_robot_can_be_copied_and_stored() -> None:
    robot = Counter()
    watch = Watch(robot)
    robot.reset()
    for copy in (deepcopy(robot), pickle.loads(pickle.dumps(robot))):  # noqa: S301 (our own)
        copy.reset()
        copy.step(NOTHING)
        assert copy.clock == 1
        assert Watch(copy).calls == 3
    assert (watch.resets, watch.calls, robot.clock) == (1, 1, 0)
    assert Watch(gym.wrappers.TimeLimit(robot, 3)).calls == 1  # whoever looks, counts the same


class Broken(gym.Wrapper[Any, Any, Any, Any]):
    """Raises before or behind a step of the robot."""

    def __init__(self, behind: bool) -> None:
        super().__init__(Counter())
        self.behind = behind

    def step(self, action: Any) -> Any:
        if self.behind:
            self.env.step(action)
        raise ConnectionError("the cable is loose")


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize("bad", [0, 1, 2])
def test_what_a_wrapper_raises_names_its_robot(bad: int, behind: bool) -> None:
    robots = [(lambda: Broken(behind)) if i == bad else Counter for i in range(3)]
    env = DummyVecEnv(robots)
    env.reset()
    with pytest.raises(ConnectionError, match=rf"the cable is loose\nRobot {bad} of 3 raised it\."):
        VecWatch(env).step(np.tile(NOTHING, (3, 1)))


def test_what_no_robot_raises_names_none() -> None:
    env = DummyVecEnv([Counter] * 3)
    env.reset()
    env.step_wait = lambda: None  # type: ignore[method-assign, assignment, return-value]
    with pytest.raises(TypeError) as caught:
        VecWatch(env).step(np.tile(NOTHING, (3, 1)))
    assert not hasattr(caught.value, "__notes__")


def test_watching_passes_gymnasiums_own_check(agent: FAMLE, make_env: MakeEnv) -> None:
    env = make_env()
    Watch(env)
    env.reset(seed=3, options={"situation": "joint 0 dead"})
    assert env.get_wrapper_attr("situation").label == "joint 0 dead"


# --- predict with a state -------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_environment_of_gymnasium_in_every_mode(agent: FAMLE, mode: AutoresetMode) -> None:
    env = gym.vector.SyncVectorEnv([lambda: gym.wrappers.TimeLimit(Counter(), 3)] * 2, autoreset_mode=mode)
    obs, _ = env.reset(seed=0)
    state, done, last_done = None, np.zeros(2, dtype=bool), np.zeros(2, dtype=bool)
    for _ in range(12):
        starts = last_done if mode is AutoresetMode.NEXT_STEP else done
        action, state = agent.predict(obs, state, episode_start=starts)
        obs, _, terminated, truncated, _ = env.step(action)
        last_done, done = done, terminated | truncated
        if mode is AutoresetMode.DISABLED and done.any():
            obs, _ = env.reset(options={"reset_mask": done})
    # Of every three steps the last is lost where the robots are put back at once, else of every four the fourth.
    assert_single_steps(agent, 9 if mode is AutoresetMode.NEXT_STEP else 8, 2, state)


def test_vector_environment_of_gymnasium_is_no_robot_of_an_agent(agent: FAMLE) -> None:
    env: Any = gym.vector.SyncVectorEnv([Counter] * 2)
    for give in (lambda: FAMLE(env, device="cpu"), lambda: agent.set_env(env), lambda: FAMLEWrapper(env, agent)):
        with pytest.raises(ValueError, match=r"DummyVecEnv.*episode_start.*NEXT_STEP"):
            give()


def test_state_whose_observation_was_refused_goes_on_without_that_step(agent: FAMLE) -> None:
    robot, state = Counter(), None
    robot.hides_at = 3
    obs, _ = robot.reset()
    for _ in range(7):
        try:
            action, state = agent.predict(obs, state)
        except ValueError:
            action = NOTHING
        obs, *_ = robot.step(action)
    assert_single_steps(agent, 4, state=state)


# --- learn ----------------------------------------------------------------------------------------------------


def test_learn_after_a_step_that_failed(agent: FAMLE) -> None:
    robots = [Counter(), Counter()]
    agent.set_env(DummyVecEnv([lambda: robots[0], lambda: robots[1]]))
    robots[1].fails_at = 4  # when the first robot has moved already
    with pytest.raises(ConnectionError):
        agent.learn(20)
    agent.learn(10, reset_num_timesteps=False)
    assert_single_steps(agent, 4 + 5, 2)


def test_learn_after_an_observation_that_was_refused(agent: FAMLE) -> None:
    robot = Counter()
    robot.hides_at = 3
    agent.set_env(robot)
    agent.config = agent.config.changed(blind_steps=0)
    with pytest.raises(ValueError, match="holds NaN"):
        agent.learn(10)
    robot.hides_at = -1
    agent.learn(5, reset_num_timesteps=False)
    assert_single_steps(agent, 2 + 5)


@pytest.mark.parametrize("resets", [False, True])
def test_learn_goes_on_where_it_was(agent: FAMLE, resets: bool) -> None:
    robot = Counter()
    agent.set_env(robot)
    for _ in range(3):
        agent.learn(4, reset_num_timesteps=resets)
    assert_single_steps(agent, 12)
    assert robot.episode == (3 if resets else 1)


@pytest.mark.parametrize("move", ["reset", "reset of the robot", "evaluation"])
def test_learn_after_somebody_else_moved_the_robot(agent: FAMLE, move: str) -> None:
    robot = Counter(6)
    agent.set_env(robot)
    agent.learn(4)
    known = agent.get_env()
    {
        "reset": known.reset,
        "reset of the robot": robot.reset,
        "evaluation": lambda: evaluate_policy(agent, known, 1, warn=False),
    }[move]()
    agent.learn(4, reset_num_timesteps=False)
    assert_single_steps(agent, 8)


def test_callback_that_evaluates_on_the_robot(agent: FAMLE) -> None:
    class Evaluate(BaseCallback):
        def _on_step(self) -> bool:
            if self.n_calls == 3:
                evaluate_policy(self.model, self.training_env, 1, warn=False)
            return True

    agent.set_env(Counter(5))
    agent.learn(6, callback=Evaluate())
    assert_single_steps(agent, 6)


def test_callback_that_is_interrupted_loses_nothing(agent: FAMLE) -> None:
    def interrupt(local: dict[str, Any], _: Any) -> bool:
        if local["self"].num_timesteps == 3:
            raise KeyboardInterrupt
        return True

    robot = Counter()
    agent.set_env(robot)
    with pytest.raises(KeyboardInterrupt):
        agent.learn(10, callback=interrupt)
    agent.learn(4, reset_num_timesteps=False)
    assert_single_steps(agent, 3 + 4)
    assert robot.episode == 1


def test_robots_in_a_vec_env_that_reset_themselves(agent: FAMLE) -> None:
    class Restless(Counter):
        def step(self, action: Any) -> Any:
            returned = super().step(action)
            return (self.reset()[0], *returned[1:]) if self.clock == 4 else returned

    agent.set_env(DummyVecEnv([Restless, lambda: Restless(3)]))
    agent.learn(16)
    memory = agent.state_of(2).memory
    change: Tensor = (memory.next_obs - memory.obs)[memory.weight > 0]
    torch.testing.assert_close(change, torch.tensor([[0.0, 1.0]]).expand(len(change), 2))
    assert len(change) == 6 + 8


# --- simulation -----------------------------------------------------------------------------------------------


class Restarting(Clock):
    def step(self, action: Any) -> Any:
        returned = super().step(action)
        return (self.reset()[0], *returned[1:]) if self.clock == 3 else returned


def test_simulation_that_resets_itself_is_refused() -> None:
    with pytest.raises(ValueError, match=r"resets itself within a step.*Autoreset"):
        collected(envs=[Restarting()])
    search = Search(PolicySearch(40, hidden=(4,), random_steps=5), [Restarting()], ["a"], 0)
    with pytest.raises(ValueError, match="resets itself within a step"):
        list(search.run())


def test_simulation_in_an_autoreset_wrapper_is_that_without() -> None:
    wrapped, plain = collected(envs=[gym.wrappers.Autoreset(Clock(3))]), collected(envs=[Clock(3)])
    np.testing.assert_array_equal(wrapped.next_obs, plain.next_obs)
