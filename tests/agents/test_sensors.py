"""Sensors that fail while an agent drives its robot: nothing false is learnt, and a valid action comes out."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
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
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import Tensor

from famle_agent import AMPC, FAMLE, FAMLEWrapper, OnlineState, SensorError
from famle_agent.agents.agent import ModelBasedAgent
from famle_agent.agents.config import Config

Array = npt.NDArray[Any]
GAIN, DIM = 0.05, 3


class Cart(gym.Env[Any, Any]):
    """Moves by a twentieth of its action, and observes by sensors that the test breaks."""

    observation_space = spaces.Box(np.float32([-10.0, -10.0, -np.inf]), np.float32([10.0, 10.0, np.inf]))
    action_space = spaces.Box(np.float32([-2.0, -1.0]), np.float32([2.0, 3.0]))

    def __init__(self, gain: float = 1.0, sense: Callable[[int, Array], Any] = lambda step, obs: obs) -> None:
        self.gain, self.sense, self.fails_at = gain, sense, -1
        self.actions: list[Array] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        x, y = self.np_random.uniform(-1, 1, 2)
        self.obs, self.clock = np.float32([x, y, x - y]), 0
        return self.sense(0, self.obs.copy()), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action)
        self.actions.append(action)
        self.clock += 1
        if self.clock == self.fails_at:
            raise ConnectionError("the cable is loose")
        self.obs[:2] += GAIN * self.gain * action
        self.obs[2] = self.obs[0] - self.obs[1]
        obs = self.sense(self.clock, self.obs.copy())
        return obs, -np.square(0.0 if obs is None else obs - 5.0).sum(), False, False, {}


SETTINGS: dict[str, Any] = {
    "policy_steps": 0,
    "transitions_per_situation": 60,
    "hidden": (16,),
    "candidates": 6,
    "planner_iterations": 1,
    "horizon": 4,
    "elites": 2,
    "adapt_every": 2,
    "adapt_steps": 3,
    "memory_size": 20,
    "joint_iterations": 60,
    "meta_iterations": 0,
}
FILTER = {"hazard": 0.01, "likelihood_power": 0.5, "compose": True, "members": 2}
KINDS: dict[str, tuple[type[ModelBasedAgent], dict[str, Any]]] = {
    "window": (FAMLE, {"warm_start": False, "hazard": 0.0, "compose": False}),
    "filter": (FAMLE, {"degrees_of_freedom": 3.0, "adapt_batch_size": 8, **FILTER}),
    "sgd": (AMPC, {"joint_iterations": 0, "adapt_optimizer": "sgd", "adapt_lr": 0.3}),
}


def towards_the_corner(obs: Tensor, action: Tensor, next_obs: Tensor) -> Tensor:
    return -(next_obs[..., :2] - 5.0).square().sum(dim=-1)


@cache
def model_of(kind: str) -> dict[str, Any]:
    agent = make(kind)
    agent.meta_learn([Cart, lambda: Cart(-1.0), lambda: Cart(0.3)], check=False)
    return {"parameters": agent.get_parameters()}


def make(kind: str, **settings: Any) -> ModelBasedAgent:
    cls, own = KINDS[kind]
    settings = {**SETTINGS, **own, **settings}
    return cls(Cart(), reward_fn=towards_the_corner, device="cpu", seed=0, **settings)


def agent_of(kind: str = "window", **settings: Any) -> ModelBasedAgent:
    agent = make(kind, **settings)
    agent.set_parameters(model_of(kind)["parameters"])
    return agent


@cache
def known_agent(kind: str) -> ModelBasedAgent:
    return agent_of(kind, safe_action=[0.5, 0.5])


def used_agent(kind: str) -> ModelBasedAgent:
    """An agent that many examples share, since making one takes longer than they do."""
    known_agent(kind).forget()
    return known_agent(kind)


def assert_finite(state: OnlineState) -> None:
    """What is believed, and what is remembered, is finite."""
    memory = {name: value for name, value in vars(state.memory).items() if name != "own_log_p"}
    for name, value in {**state.to_tensors(), **memory}.items():
        if name != "memory.own_log_p":
            assert value.isfinite().all(), name


def nan_at(*steps: int) -> Callable[[int, Array], Any]:
    return lambda step, obs: obs * np.nan if step in steps else obs


# --- the law --------------------------------------------------------------------------------------------------

GARBAGE = st.one_of(
    st.floats(width=32, allow_nan=True, allow_infinity=True),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e30, -3e38, 29.9, -29.9]),
    st.floats(-3, 3, width=32),
)
STREAM = st.lists(npst.arrays(np.float32, DIM, elements=GARBAGE), min_size=1, max_size=8)


@given(st.sampled_from(list(KINDS)), STREAM, st.booleans())
def test_any_stream_of_observations_gives_valid_actions_and_finite_beliefs(
    kind: str, stream: list[Array], by_wrapper: bool
) -> None:
    agent = used_agent(kind)
    robot = Cart(sense=lambda step, obs: stream[step % len(stream)])
    env = FAMLEWrapper(robot, agent) if by_wrapper else robot
    obs, _ = env.reset(seed=0)
    state = None
    for _ in range(2 * len(stream)):
        action, new = agent.predict(obs, state)
        state = None if by_wrapper else new
        assert robot.action_space.contains(action)
        obs, *_ = env.step(action)
        assert_finite(agent.state_of(1) if by_wrapper else new)
        assert all(np.isfinite(list(agent.posterior(state).values())))


@given(st.sampled_from(list(KINDS)), STREAM)
def test_any_stream_of_one_robot_among_others(kind: str, stream: list[Array]) -> None:
    agent = used_agent(kind)
    agent.set_env(DummyVecEnv([Cart, lambda: Cart(sense=lambda step, obs: stream[step % len(stream)])]))
    agent.learn(4 * len(stream))
    assert_finite(agent.state_of(2))
    assert agent.health(robot=0)["quarantined"] == 0


# --- what is quarantined --------------------------------------------------------------------------------------

BAD: dict[str, Callable[[Array], Any]] = {
    "NaN": lambda obs: obs * np.nan,
    "one NaN": lambda obs: np.where([True, False, False], np.nan, obs),
    "infinity": lambda obs: np.where([False, True, False], np.inf, obs),
    "out of range": lambda obs: np.where([False, True, False], 40.0, obs),
    "jump": lambda obs: obs + np.array([0.0, 0.0, 25.0]),
    "no message": lambda obs: None,
}


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD)
@pytest.mark.parametrize("door", ["wrapper", "state", "learn", "observe"])
def test_observation_that_cannot_be_a_measurement_is_in_no_memory(bad: Callable[[Array], Any], door: str) -> None:
    def sense(step: int, obs: Array) -> Any:
        return np.float32(bad(obs)) if step == 4 and bad(obs) is not None else None if step == 4 else obs

    agent, robot = agent_of(), Cart(sense=sense)
    state = drive(agent, robot, 9, door)
    memory = state.memory
    assert memory.seen == 7  # of nine transitions, without the one before and the one after
    changes = (memory.next_obs - memory.obs)[memory.weight > 0]
    assert changes.abs().max() < 1.0
    given_state = state if door == "state" else None
    assert agent.health(given_state) == {
        **dict.fromkeys(("dropped", "repeated", "blind", "overruns", "cut_short", "left_out"), 0),
        "quarantined": 2,
    }
    assert len(robot.actions) == 9


def drive(agent: ModelBasedAgent, robot: Cart, steps: int, door: str) -> OnlineState:
    """Drives a robot with an agent; what it believes in the end."""
    if door == "learn":
        agent.set_env(robot)
        agent.set_random_seed(0)
        agent.learn(steps)
        return agent.state_of(1)
    env = FAMLEWrapper(robot, agent) if door == "wrapper" else robot
    obs, _ = env.reset(seed=0)
    state = None
    for _ in range(steps):
        action, new = agent.predict(obs, state)
        state = new if door == "state" else None
        before, (obs, *_) = obs, env.step(action)
        if door == "observe":
            agent.observe(before, action, obs)
    return agent.predict(obs, state)[1] if door == "state" else agent.state_of(1)


@pytest.mark.parametrize("door", ["wrapper", "state", "learn", "observe"])
def test_plans_begin_where_the_model_says_that_the_robot_is(door: str) -> None:
    agent, robot = agent_of(), Cart(sense=nan_at(5, 6, 7))
    state = drive(agent, robot, 7, door)
    senses = state.senses
    assert senses is not None
    assert senses.blind.tolist() == [3]
    last_seen = robot.obs[:2] - GAIN * np.sum(robot.actions[4:], axis=0)
    there = np.abs(senses.obs[0, :2].numpy() - robot.obs[:2]).max()
    assert there < 0.5 * np.abs(last_seen - robot.obs[:2]).max()


def test_jump_that_the_next_reading_confirms_is_where_the_robot_is() -> None:
    agent, robot = agent_of(), Cart(sense=lambda step, obs: obs + np.float32([0, 0, 15.0 * (step >= 4)]))
    state = drive(agent, robot, 9, "state")
    assert agent.health(state)["quarantined"] == 2
    assert state.senses is not None
    np.testing.assert_allclose(state.senses.obs[0], robot.sense(9, robot.obs))


def test_surprises_that_a_sensor_can_measure_are_learnt_from() -> None:
    """A frozen, a biased, a late and a noisy sensor are situations."""
    frozen: list[Array] = []

    def sense(step: int, obs: Array) -> Array:
        frozen.append(obs.copy())
        return np.float32([frozen[min(step, 3)][0], obs[1] + 0.5 * (step > 5), frozen[max(step - 2, 0)][2]])

    agent = agent_of()
    assert agent.health(drive(agent, Cart(sense=sense), 12, "state"))["quarantined"] == 0


def test_repeated_message_is_counted_and_learnt_from() -> None:
    """A robot that stands still looks the same: quarantining it would hide that its motors are dead."""
    agent = agent_of()
    assert drive(agent, Cart(gain=0.0), 6, "wrapper").memory.seen == 6
    assert agent.health()["repeated"] == 6


# --- how long, and what then ----------------------------------------------------------------------------------


@pytest.mark.parametrize("blind_steps", [0, 3, None])
@pytest.mark.parametrize("door", ["wrapper", "state", "learn", "observe"])
def test_error_after_a_number_of_steps(blind_steps: int | None, door: str) -> None:
    robot = Cart(sense=lambda step, obs: obs * np.nan if step >= 5 else obs)
    agent = agent_of(blind_steps=blind_steps)
    with pytest.raises(SensorError, match=r"observation holds NaN.*blind_steps.*safe_action"):
        drive(agent, robot, 30, door)
    assert len(robot.actions) == 5 + (SETTINGS["horizon"] if blind_steps is None else blind_steps)


@pytest.mark.parametrize("door", ["wrapper", "state", "learn", "observe"])
def test_safe_action_after_a_number_of_steps(door: str) -> None:
    robot = Cart(sense=lambda step, obs: obs * np.nan if step >= 5 else obs)
    drive(agent_of(blind_steps=2, safe_action=(0.5, 2.5)), robot, 12, door)
    np.testing.assert_allclose(robot.actions[7:], np.tile([0.5, 2.5], (5, 1)), atol=1e-6)
    assert not np.allclose(robot.actions[6], [0.5, 2.5])


def test_robot_that_was_never_seen_is_told_what_is_safe() -> None:
    robot = Cart(sense=lambda step, obs: obs * np.nan if step < 3 else obs)
    agent = agent_of(safe_action=(0.0, 1.0))
    assert drive(agent, robot, 8, "state").memory.seen == 5
    np.testing.assert_allclose(robot.actions[:3], np.tile([0.0, 1.0], (3, 1)), atol=1e-6)
    with pytest.raises(SensorError, match="no other since the robot began"):
        agent_of().predict(np.full(DIM, np.nan))


def test_robot_that_sees_again_goes_on() -> None:
    agent, state = agent_of(blind_steps=1), None
    robot = Cart(sense=nan_at(3, 4, 5))
    obs, _ = robot.reset(seed=0)
    errors = 0
    for _ in range(9):
        try:
            action, state = agent.predict(obs, state)
        except SensorError:
            errors, action = errors + 1, np.zeros(2, np.float32)
        obs, *_ = robot.step(action)
    assert errors == 2
    _, state = agent.predict(obs, state)
    assert state.memory.seen == 2 + 3  # what lies across the refused calls is no step of the state


@pytest.mark.parametrize("wrong", [(0.5,), (0.5, 3.5), (np.nan, 0.0), "left"])
def test_safe_action_that_is_none_is_refused(wrong: Any) -> None:
    with pytest.raises((TypeError, ValueError), match="safe_action must be"):
        make("window", safe_action=wrong)


def test_safety_is_kept_in_files(tmp_path: Any) -> None:
    settings = {"blind_steps": 7, "safe_action": [0.5, 1.0], "step_budget_ms": 20.0}
    config = Config.of(settings)
    assert (config.safety.blind_steps, config.safety.safe_action) == (7, (0.5, 1.0))
    assert Config.of(config.to_dict()) == config
    agent = agent_of(**settings)
    agent.save(tmp_path / "agent.zip")
    loaded = FAMLE.load(tmp_path / "agent.zip", Cart(), reward_fn=towards_the_corner)
    assert loaded.config.safety == agent.config.safety


# --- what is said about it ------------------------------------------------------------------------------------


def test_info_counts_what_was_missing() -> None:
    agent = agent_of()
    env = FAMLEWrapper(Cart(sense=nan_at(3, 4)), agent)
    obs, info = env.reset(seed=0)
    infos = []
    for _ in range(6):
        obs, _, _, _, info = env.step(agent.predict(obs)[0])
        infos.append(info["famle"])
    assert [info["quarantined"] for info in infos] == [0, 0, 1, 2, 3, 3]
    assert [info["blind"] for info in infos] == [0, 0, 1, 2, 0, 0]
    agent.forget()
    assert agent.health()["quarantined"] == 0


def test_first_failure_is_warned_of() -> None:
    with pytest.warns(UserWarning, match=r"robot 0 cannot be a measurement: \[nan"):
        drive(agent_of(), Cart(sense=nan_at(3)), 4, "state")


def test_info_counts_steps_that_were_no_transition() -> None:
    robot = Cart()
    agent = agent_of()
    env = FAMLEWrapper(robot, agent)
    env.reset(seed=0)
    action = np.zeros(2, np.float32)
    env.step(action)
    robot.reset()  # by somebody else
    assert env.step(action)[4]["famle"]["dropped"] == 1
    robot.fails_at = 2
    with pytest.raises(ConnectionError):
        env.step(action)
    assert env.step(action)[4]["famle"]["dropped"] == 3  # nor is it known where this one began
    assert env.step(action)[4]["famle"]["dropped"] == 3


def test_learn_counts_steps_that_were_no_transition() -> None:
    robots = [Cart(), Cart()]
    agent = agent_of()
    agent.set_env(DummyVecEnv([lambda: robots[0], lambda: robots[1]]))

    class Reset(BaseCallback):
        def _on_step(self) -> bool:
            return True

    robots[1].fails_at = 4
    with pytest.raises(ConnectionError):
        agent.learn(20, callback=Reset())
    assert [agent.health(robot=i)["dropped"] for i in range(2)] == [1, 1]

    def restless(step: int, obs: Array) -> Array:
        return robots[1].reset()[0] if step == 3 else obs

    robots[1].sense = restless
    agent.learn(10, reset_num_timesteps=False)
    assert [agent.health(robot=i)["dropped"] for i in range(2)] == [1, 2]


def test_tensorboard_counts_what_was_missing(tmp_path: Any) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    agent = agent_of(step_budget_ms=1e-3)
    agent.tensorboard_log = str(tmp_path)
    agent.set_env(DummyVecEnv([Cart, lambda: gym.wrappers.TimeLimit(Cart(sense=nan_at(3)), 6)]))
    agent.learn(12)
    events = EventAccumulator(str(next(tmp_path.rglob("events*")).parent)).Reload()
    last = {name: events.Scalars(f"health/{name}")[-1].value for name in ("quarantined", "dropped", "overruns")}
    assert last == {"quarantined": 2, "dropped": 0, "overruns": 6}


def test_first_observation_that_fails_says_nothing_of_the_posterior() -> None:
    agent = agent_of("filter")
    env = FAMLEWrapper(Cart(sense=lambda step, obs: obs * np.nan), agent)
    env.reset(seed=0)
    prior = agent.posterior()
    env.step(np.zeros(2, np.float32))
    assert agent.posterior() == prior
    assert torch.equal(agent.belief.excess, torch.ones(1, DIM))
