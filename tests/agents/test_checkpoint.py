from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from famle_agent import FAMLE, FAMLEWrapper, NotLearnedError, Transitions
from famle_agent.agents.checkpoint import box_from_json, box_to_json, read_checkpoint, write_checkpoint
from famle_envs.reacher import ReacherEnv

Load = Callable[..., FAMLE]
MakeEnv = Callable[..., gym.Env[Any, Any]]
FLOAT32 = st.floats(width=32, allow_nan=False)


@pytest.fixture
def reload() -> Iterator[Callable[..., FAMLE]]:
    """Saves an agent to memory and loads it."""
    agents: list[FAMLE] = []

    def through_bytes(agent: FAMLE, **kwargs: Any) -> FAMLE:
        buffer = io.BytesIO()
        agent.save(buffer)
        buffer.seek(0)
        agents.append(FAMLE.load(buffer, device="cpu", **kwargs))
        return agents[-1]

    yield through_bytes
    for agent in agents:
        if agent.get_env() is not None:
            agent.get_env().close()


def actions(agent: FAMLE, n: int = 3, obs: Any = None) -> list[np.ndarray[Any, Any]]:
    if obs is None:
        obs = np.linspace(-0.5, 0.5, agent.observation_space.shape[0], dtype=np.float32)
    return [agent.predict(obs)[0] for _ in range(n)]


# --- what a loaded agent is -------------------------------------------------------------------------------


def test_fresh_agent_acts_as_the_saved_one(quick_agent: FAMLE, reload: Load) -> None:
    loaded = reload(quick_agent)
    assert loaded.config == quick_agent.config
    assert loaded.situations == quick_agent.situations
    assert (loaded.mode, loaded.seed) == (quick_agent.mode, quick_agent.seed)
    assert loaded.observation_space == quick_agent.observation_space
    assert loaded.get_env().get_attr("spec")[0].id == "FamleReacher-v0"
    np.testing.assert_array_equal(actions(loaded), actions(quick_agent))


def test_agent_that_learned_on_its_robot_goes_on(quick_agent: FAMLE, reload: Load, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(make_env(situation="joint 0 reversed"), quick_agent)
    obs, _ = env.reset(seed=0)
    for _ in range(13):
        obs, *_ = env.step(quick_agent.predict(obs)[0])
    loaded = reload(quick_agent)
    assert loaded.posterior() == quick_agent.posterior()
    assert loaded.belief.adaptations == quick_agent.belief.adaptations == 2
    for agent in (loaded, quick_agent):  # the next adaptation comes at the same step
        agent.observe(obs, np.zeros(5), obs)
        assert agent.belief.adaptations == 2
        agent.observe(obs, np.zeros(5), obs)
        assert agent.belief.adaptations == 3
    np.testing.assert_array_equal(actions(loaded), actions(quick_agent))


def test_learned_reward_is_kept(reload: Load) -> None:
    small = {"hidden": (8,), "policy_steps": 0, "transitions_per_situation": 30, "joint_iterations": 2}
    agent = FAMLE("Pendulum-v1", seed=0, device="cpu", **small)
    agent.meta_learn([lambda g=g: gym.make("Pendulum-v1", g=g) for g in (3.0, 10.0)])
    obs = np.array([1.0, 0.0, 0.5], dtype=np.float32)
    np.testing.assert_array_equal(actions(reload(agent), obs=obs), actions(agent, obs=obs))


def test_agent_that_has_learned_nothing(reload: Load) -> None:
    agent = FAMLE("reacher", "paper", seed=3, device="cpu", horizon=4)
    loaded = reload(agent)
    assert loaded.config == agent.config
    assert loaded.mode == "paper"
    with pytest.raises(NotLearnedError):
        loaded.posterior()
    agent.get_env().close()


def test_settings_and_environment_can_be_changed(agent_file: Path, make_env: MakeEnv) -> None:
    broken = make_env(situation="joint 3 dead")
    agent = FAMLE.load(agent_file, env=broken, device="cpu", adapt_every=0, candidates=5, verbose=1)
    assert agent.config.adaptation.every == 0
    assert agent.verbose == 1
    agent.learn(12)
    assert agent.belief.adaptations == 0
    assert agent.get_env().get_attr("situation")[0].label == "joint 3 dead"


def test_seed_can_be_changed(agent_file: Path) -> None:
    agents = [FAMLE.load(agent_file, device="cpu", seed=seed) for seed in (1, 1, 2)]
    assert [agent.seed for agent in agents] == [1, 1, 2]
    one, same, other = (actions(agent) for agent in agents)
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_loaded_agent_counts_on(quick_agent: FAMLE, reload: Load) -> None:
    quick_agent.learn(20)
    loaded = reload(quick_agent)
    assert loaded.num_timesteps == 20
    assert loaded.learn(10, reset_num_timesteps=False).num_timesteps == 30


def test_robot_of_a_loaded_agent_starts_alike_each_time(reload: Load) -> None:
    agent = FAMLE("ant", seed=3, device="cpu")
    first, second = (reload(agent).get_env().reset() for _ in range(2))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, FAMLE("ant", seed=3, device="cpu").get_env().reset())


def test_time_limit_is_kept(make_env: MakeEnv, reload: Load) -> None:
    loaded = reload(FAMLE(make_env(max_episode_steps=7), device="cpu"))
    assert loaded.get_env().get_attr("spec")[0].max_episode_steps == 7


def test_folder_of_the_same_name_is_not_taken_for_the_file(agent_file: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine.zip").write_bytes(agent_file.read_bytes())
    assert FAMLE.load(tmp_path / "mine", device="cpu").dynamics is not None


def test_other_mode_is_refused(agent_file: Path) -> None:
    with pytest.raises(ValueError, match="no other mode"):
        FAMLE.load(agent_file, mode="paper")


def test_robots_that_adapt_between_episodes_do_so_once_after_loading_too(
    transitions: Transitions, make_env: MakeEnv, reload: Load
) -> None:
    settings = {"adapt_every": 0, "adapt_at_reset": True, "candidates": 5, "planner_iterations": 1}
    agent = FAMLE(make_env(), seed=0, device="cpu", meta_iterations=2, **settings).meta_learn(transitions)
    agent.learn(50 + 3)
    agent.begin_episode()
    assert agent.belief.adaptations == 2
    copy = reload(agent)
    copy.begin_episode()
    assert copy.belief.adaptations == 2


def test_horizon_can_be_changed_where_the_agent_has_a_plan(quick_agent: FAMLE, reload: Load) -> None:
    quick_agent.learn(2)
    loaded = reload(quick_agent, horizon=3, memory_size=7)
    _, state = loaded.predict(np.zeros(12, np.float32))
    assert state.plan.shape == (1, 3, 5)
    assert state.memory.weight.shape == (1, 7)


def test_environment_that_was_given_later_is_the_one_named(quick_agent: FAMLE, reload: Load, make_env: MakeEnv) -> None:
    quick_agent.get_env().close()
    quick_agent.set_env(make_env(goal=(1.0, -0.5)))
    assert reload(quick_agent).get_env().get_attr("goal")[0] == (1.0, -0.5)


def test_situation_of_the_environment_is_named(make_env: MakeEnv, reload: Load) -> None:
    agent = FAMLE(make_env(situation={"motor_gain": [1, 0.5], "partial": True}), device="cpu")
    assert reload(agent).get_env().get_attr("situation")[0].motor_gain[:2] == (1.0, 0.5)


def test_settings_that_change_the_network_are_refused(agent_file: Path) -> None:
    changes = [{"hidden": (3,)}, {"embedding_dim": 2}, {"gate_actions": False}, {"members": 2}, {"interaction_rank": 1}]
    for override in changes:
        with pytest.raises(ValueError, match="an override changed the network"):
            FAMLE.load(agent_file, device="cpu", **override)


def test_environment_with_other_spaces_is_refused(agent_file: Path) -> None:
    with pytest.raises(ValueError, match="are not the agent's"):
        FAMLE.load(agent_file, env="Pendulum-v1", device="cpu")


def test_reward_function_has_to_be_given_again(transitions: Transitions, reload: Load) -> None:
    def reward(obs: torch.Tensor, action: torch.Tensor, next_obs: torch.Tensor) -> torch.Tensor:
        return -next_obs[..., 0]

    agent = FAMLE("reacher", reward_fn=reward, seed=0, device="cpu", meta_iterations=1, inner_steps=1)
    agent.get_env().close()
    agent.meta_learn(transitions)
    with pytest.raises(ValueError, match=r"reward_fn=\.\.\."):
        reload(agent)
    np.testing.assert_array_equal(actions(reload(agent, reward_fn=reward)), actions(agent))


def test_environment_that_no_file_can_name_has_to_be_given(make_env: MakeEnv, reload: Load) -> None:
    unregistered = ReacherEnv()
    wrapped = gym.wrappers.TransformReward(make_env(), float)
    for env in (unregistered, wrapped):
        agent = FAMLE(env, device="cpu")
        loaded = reload(agent)
        assert loaded.get_env() is None
        assert loaded.action_space == agent.action_space
        assert loaded.observation_space == agent.observation_space
        reload(agent, env=env)
    unregistered.close()


# --- the parts ----------------------------------------------------------------------------------------------


@given(
    st.dictionaries(st.text(), FLOAT32 | st.text() | st.none() | st.lists(st.integers())),
    st.dictionaries(
        st.text(st.characters(codec="ascii", exclude_categories=("C",)), min_size=1),
        npst.arrays(np.float32, npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3), elements=FLOAT32),
        max_size=3,
    ),
)
def test_what_is_written_is_read(meta: dict[str, Any], arrays: dict[str, Any]) -> None:
    meta = {key: value for key, value in meta.items() if key not in ("format", "version")}
    arrays.pop("__metadata__", None)
    buffer = io.BytesIO()
    write_checkpoint(buffer, meta, {name: torch.from_numpy(array) for name, array in arrays.items()})
    buffer.seek(0)
    read, tensors = read_checkpoint(buffer)
    assert {key: read[key] for key in meta} == meta
    assert set(tensors) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(tensors[name].numpy(), array)


@given(
    st.sampled_from(["float32", "float64"]).flatmap(
        lambda dtype: st.tuples(
            st.just(dtype), npst.arrays(dtype, st.integers(1, 4), elements=st.floats(-1e6, 1e6, width=32))
        )
    ),
    st.lists(st.booleans(), min_size=4, max_size=4),
)
def test_spaces_survive(values: tuple[str, Any], infinite: list[bool]) -> None:
    dtype, low = values
    high = low + 1
    low, high = np.where(infinite[: len(low)], -np.inf, low), np.where(infinite[: len(low)][::-1], np.inf, high)
    space = spaces.Box(low.astype(dtype), high.astype(dtype), dtype=np.dtype(dtype).type)
    assert box_from_json(json.loads(json.dumps(box_to_json(space)))) == space
