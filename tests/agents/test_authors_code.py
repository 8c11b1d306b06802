from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from famle_agent import AMPC, FAMLE, FAMLEWrapper, OnlineState, Transitions
from famle_agent.models.dynamics import Batch, Dynamics, Theta
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.models.simulator import Simulator
from famle_envs.reacher import ReacherEnv

Load = Callable[..., FAMLE]
EPISODE = 6
TINY: dict[str, Any] = {
    "device": "cpu",
    "transitions_per_situation": 40,
    "hidden": (8,),
    "meta_iterations": 3,
    "inner_steps": 3,
    "memory_size": 100,
    "adapt_epochs": 3,
    "adapt_batch_size": 4,
    "adapt_lr": 0.01,
    "adapt_embedding_lr": 0.01,
    "horizon": 3,
    "candidates": 20,
}


@pytest.fixture(scope="module")
def data() -> Transitions:
    agent = FAMLE("reacher", "original", seed=0, **TINY)
    transitions = agent.collect()
    agent.get_env().close()
    return transitions


@pytest.fixture(scope="module")
def file(data: Transitions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small agent that adapts as the original one does, for short episodes."""
    agent = FAMLE(make_robot(), "original", seed=0, **TINY)
    path = tmp_path_factory.mktemp("original") / "reacher.zip"
    agent.meta_learn(data).save(path)
    agent.get_env().close()
    return path


def make_robot(**kwargs: Any) -> gym.Env[Any, Any]:
    return gym.make("FamleReacher-v0", max_episode_steps=EPISODE, **kwargs)


@pytest.fixture
def load(file: Path) -> Iterator[Load]:
    """Loads fresh copies of the small agent, on one robot or several."""
    agents: list[FAMLE] = []

    def load_agent(robots: int = 1, source: Any = file, **overrides: Any) -> FAMLE:
        env = DummyVecEnv([lambda: Monitor(make_robot())] * robots)
        agents.append(FAMLE.load(source, env, device="cpu", **overrides))
        return agents[-1]

    yield load_agent
    for agent in agents:
        agent.get_env().close()


def counted(agent: FAMLE, door: str, episodes: int, **robot: Any) -> list[int]:
    """How often the agent has adapted when it plans each action, however it is told what happens."""
    counts: list[int] = []
    kind = type(agent.adapter)
    plan = kind.model_for

    def model_for(self: Any, belief: Any, memory: Any) -> Any:
        counts.append(belief.adaptations)
        return plan(self, belief, memory)

    with patch.object(kind, "model_for", model_for):
        if door == "learn":
            agent.learn(episodes * EPISODE)
        elif door == "state":
            evaluate_policy(agent, agent.get_env(), n_eval_episodes=episodes, warn=False)
        else:
            wrapped(agent, episodes, **robot)
    return counts


def wrapped(agent: FAMLE, episodes: int, **robot: Any) -> list[int]:
    """How often the agent has adapted after each reset and each step of some episodes."""
    env, counts = FAMLEWrapper(make_robot(**robot), agent), []
    for episode in range(episodes):
        obs, info = env.reset(seed=episode)
        counts.append(info["famle"]["adaptations"])
        for _ in range(EPISODE):
            obs, *_, info = env.step(agent.predict(obs)[0])
            counts.append(info["famle"]["adaptations"])
    env.close()
    return counts


@pytest.fixture
def rules(monkeypatch: pytest.MonkeyPatch) -> list[InnerLoop]:
    """Every update rule that is followed, as it is followed."""
    followed: list[InnerLoop] = []
    follow = InnerLoop.__call__

    def call(self: InnerLoop, *args: Any) -> Any:
        followed.append(self)
        return follow(self, *args)

    monkeypatch.setattr(InnerLoop, "__call__", call)
    return followed


# --- when it adapts, and to what --------------------------------------------------------------------------


def test_mode_is_that_of_robots_whose_code_was_published() -> None:
    for robot in ("minitaur", "quadruped"):
        with pytest.raises(ValueError, match="ours, paper, got 'original'"):
            FAMLE(robot, "original", device="cpu")


@pytest.mark.parametrize("door", ["learn", "state", "wrapper"])
def test_adapts_once_an_episode_at_its_end(load: Load, door: str) -> None:
    counts = counted(load(), door, episodes=3)
    assert counts[: 3 * EPISODE] == [0] * EPISODE + [1] * EPISODE + [2] * EPISODE


def test_wrapper_tells_of_it_at_the_reset(load: Load) -> None:
    agent = load()
    assert wrapped(agent, episodes=3) == [episode for episode in range(3) for _ in range(EPISODE + 1)]
    assert agent.belief.log_posterior.std() > 0  # it looks at every transition all the same


def test_first_episode_is_lived_with_what_was_meta_learned(load: Load, data: Transitions) -> None:
    agent = load()
    model = agent.model
    for i in range(EPISODE):
        agent.observe(data.obs[3, i], data.action[3, i], data.next_obs[3, i])
        belief = agent.belief
        assert torch.equal(belief.h[0], model.embeddings[:, 0])
        assert all(torch.equal(value[0], model.theta[name]) for name, value in belief.theta.items())
    agent.begin_episode()
    assert not torch.equal(agent.belief.theta["weight_0"][0], model.theta["weight_0"])
    assert model.embeddings[0, agent.belief.posterior.argmax()].sub(agent.belief.h).abs().max() < 0.2


def test_steps_are_passes_through_all_that_was_seen(load: Load, rules: list[InnerLoop]) -> None:
    wrapped(load(), episodes=4)
    assert [rule.steps for rule in rules] == [3 * math.ceil(n / 4) for n in (6, 12, 18)]
    assert {rule.optimizer for rule in rules} == {"adam"}


def test_each_step_sees_a_minibatch_of_the_memory(load: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes, loss = [], Dynamics.loss

    def watched(self: Dynamics, batch: Batch, h: torch.Tensor, theta: Theta) -> torch.Tensor:
        sizes.append((batch.weight.shape[-1], batch.weight.min().item()))
        return loss(self, batch, h, theta)

    monkeypatch.setattr(Dynamics, "loss", watched)
    counted(load(), "learn", episodes=3)
    assert sizes == [(4, 1.0)] * (3 * math.ceil(5 / 4) + 3 * math.ceil(10 / 4))


def test_rival_goes_on_from_episode_to_episode(data: Transitions) -> None:
    agent = AMPC(
        make_robot(), "original", seed=0, **TINY | {"meta_iterations": 0, "inner_steps": 0, "adapt_embedding_lr": 0.0}
    )
    agent.meta_learn(data).learn(2 * EPISODE + 1)
    agent.get_env().close()
    assert agent.belief.adaptations == 2


def test_episode_without_a_step_teaches_nothing(load: Load) -> None:
    agent = load()
    env = FAMLEWrapper(make_robot(), agent)
    obs, _ = env.reset(seed=0)
    env.step(agent.predict(obs)[0])
    counts = [env.reset()[1]["famle"]["adaptations"] for _ in range(2)]
    env.close()
    assert counts == [1, 1]


def test_learning_goes_on_in_the_middle_of_an_episode(load: Load) -> None:
    agent = load()
    for _ in range(2):
        agent.learn(2, reset_num_timesteps=False)
    assert agent.belief.adaptations == 0


def test_equal_states_give_equal_deterministic_actions(load: Load, data: Transitions) -> None:
    agent, state = load(adapt_lr=0.3), None
    for i in range(EPISODE):
        _, state = agent.predict(data.obs[0, i], state)
    (one, _), (same, _) = (agent.predict(data.obs[0, 0], state, np.array([True]), True) for _ in range(2))
    np.testing.assert_array_equal(one, same)


# --- several robots ---------------------------------------------------------------------------------------


def two_robots(agent: FAMLE, data: Transitions, steps: int, ends: dict[int, list[bool]]) -> OnlineState:
    """The state of two robots after some steps; an episode of a robot ends before the steps that are named."""
    state: Any = None
    for i in range(steps):
        _, state = agent.predict(data.obs[[1, 7], i], state, np.array(ends.get(i, [False, False])))
    return state


@pytest.mark.parametrize("ended", [0, 1])
def test_only_the_robot_whose_episode_ended_adapts(load: Load, data: Transitions, ended: int) -> None:
    agent, other = load(robots=2), 1 - ended
    state = two_robots(agent, data, 5, {4: [robot == ended for robot in range(2)]})
    belief, model = state.belief, agent.model
    assert torch.equal(belief.h[other, 0], model.embeddings[0, 0])
    assert not torch.equal(belief.h[ended, 0], model.embeddings[0, 0])
    for name, value in belief.theta.items():
        assert torch.equal(value[other], model.theta[name])
        assert not torch.equal(value[ended], model.theta[name])
    assert state.memory.weight.sum(dim=1).tolist() == ([3, 4] if ended == 0 else [4, 3])


def test_robots_that_have_seen_nothing_do_not_adapt(load: Load, data: Transitions) -> None:
    state = two_robots(load(robots=2), data, 2, {0: [True, True], 1: [True, True]})
    assert state.belief.adaptations == 0


def test_robots_of_a_vec_env_learn_episode_by_episode(load: Load) -> None:
    agent = load(robots=2)
    agent.learn(2 * 2 * EPISODE + 2)
    assert agent.belief.adaptations == 2
    assert not torch.equal(agent.belief.h[0], agent.belief.h[1])


# --- how it plans -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("members", [1, 2])
def test_predictions_are_bounded_from_the_first_adaptation_on(data: Transitions, members: int) -> None:
    agent = FAMLE(make_robot(), "original", seed=0, **TINY | {"members": members}).meta_learn(data)
    far, action, two = torch.full((2, 1, 12), 5.0), torch.zeros(2, 1, 5), [0, 7]
    for i in range(EPISODE):
        agent.observe(data.obs[two, i], data.action[two, i], data.next_obs[two, i])
        state = agent.state_of(2)
        free = Simulator(agent.model, state.belief.h, state.belief.theta)(far, action)
        assert torch.equal(agent.adapter.model_for(state.belief, state.memory)(far, action), free)
    agent.begin_episode()
    state = agent.state_of(2)
    seen = torch.from_numpy(np.concatenate([data.obs[two, :EPISODE], data.next_obs[two, :EPISODE]], axis=1))
    for sign in (-1.0, 1.0):
        reached = agent.adapter.model_for(state.belief, state.memory)(sign * far, action)[:, :, 0]
        assert (reached >= seen.amin(dim=1, keepdim=True)).all()
        assert (reached <= seen.amax(dim=1, keepdim=True)).all()
    agent.get_env().close()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which of the reacher's rewards a planner asks for."""
    names: list[str] = []

    def watch(name: str) -> None:
        reward = getattr(ReacherEnv, name)

        def watched(self: ReacherEnv, obs: Any, action: Any, next_obs: Any) -> Any:
            if isinstance(next_obs, torch.Tensor):
                names.append(name)
            return reward(self, obs, action, next_obs)

        monkeypatch.setattr(ReacherEnv, name, watched)

    for name in ("reward_fn", "squared_reward_fn"):
        watch(name)
    return names


@pytest.mark.parametrize("door", ["learn", "state", "wrapper"])
@pytest.mark.parametrize("origin", ["made", "saved", "another robot"])
def test_plans_for_the_square_of_the_distance(
    load: Load, data: Transitions, asked: list[str], door: str, origin: str
) -> None:
    agent = load()
    if origin == "saved":
        agent.save(buffer := io.BytesIO())
        buffer.seek(0)
        agent = load(source=buffer)
    elif origin == "another robot":
        agent.get_env().close()
        agent.set_env(Monitor(make_robot(goal=(0.5, 0.5))))
    goal = (0.5, 0.5) if origin == "another robot" else (-1.0, 1.0)
    counted(agent, door, episodes=1, goal=goal)
    assert set(asked) == {"squared_reward_fn"}
    obs, action, next_obs = (torch.from_numpy(values[0]) for values in (data.obs, data.action, data.next_obs))
    expected = torch.exp(-(next_obs[:, 10:] - torch.tensor(goal)).square().sum(dim=-1))
    torch.testing.assert_close(agent.policy.unit_reward_fn()(obs, action, next_obs), expected)


def test_other_modes_plan_for_the_distance(load: Load, asked: list[str]) -> None:
    counted(load(planning_reward=""), "learn", episodes=1)
    assert set(asked) == {"reward_fn"}


def test_reward_that_the_environment_lacks_is_refused(load: Load) -> None:
    with pytest.raises((TypeError, ValueError), match=r"has no .square_reward_fn."):
        load(planning_reward="square_reward_fn")
