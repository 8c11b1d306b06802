from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy

from famle_agent import FAMLE, FAMLEWrapper, NotLearnedError, SensorError

Load = Callable[..., FAMLE]
MakeEnv = Callable[..., gym.Env[Any, Any]]
HEALTH = {"quarantined", "blind", "dropped", "repeated", "overruns", "cut_short", "left_out"}


def run(env: FAMLEWrapper, steps: int, seed: int | None = 0) -> list[dict[str, Any]]:
    """Some steps of an episode; the info of the reset and of each step."""
    obs, info = env.reset(seed=seed)
    infos = [info]
    for _ in range(steps):
        action, _ = env.agent.predict(obs)
        obs, _, _, _, info = env.step(action)
        infos.append(info)
    return infos


def test_info_says_what_the_agent_believes(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    infos = run(FAMLEWrapper(make_env(situation="joint 3 dead"), quick_agent), 40)
    assert [info["famle"]["adaptations"] for info in infos[::5]] == list(range(9))
    for info in infos:
        belief = info["famle"]
        counts = {"adaptations", "diverged", "recognised"}
        assert set(belief) == {"situation", "probability", "posterior"} | counts | HEALTH
        assert tuple(belief["posterior"]) == quick_agent.situations
        assert sum(belief["posterior"].values()) == pytest.approx(1.0, abs=1e-5)
        assert belief["probability"] == max(belief["posterior"].values()) == belief["posterior"][belief["situation"]]
        assert info["situation"] == "joint 3 dead"
    assert infos[0]["famle"]["probability"] == pytest.approx(1 / 11)
    assert infos[-1]["famle"]["situation"] == "joint 3 dead"


def test_memory_outlasts_a_reset(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(make_env(situation="joint 0 reversed"), quick_agent)
    before = run(env, 12)[-1]["famle"]
    after = run(env, 3)
    assert after[0]["famle"] == before
    assert [info["famle"]["adaptations"] for info in after] == [2, 2, 2, 3]
    quick_agent.forget()
    assert env.reset()[1]["famle"]["adaptations"] == 0


def test_transitions_are_those_of_the_robot(load_agent: Load, make_env: MakeEnv) -> None:
    """The wrapper teaches the agent what it would have learned through its state."""
    wrapped, alone = (load_agent(adapt_every=5, adapt_steps=2, candidates=20, planner_iterations=1) for _ in range(2))
    run(FAMLEWrapper(make_env(situation="joint 0 reversed"), wrapped), 10)
    env = make_env(situation="joint 0 reversed")
    obs, _ = env.reset(seed=0)
    action, state = alone.predict(obs)
    for _ in range(10):
        obs, *_ = env.step(action)
        action, state = alone.predict(obs, state)
    assert state.belief.adaptations == wrapped.belief.adaptations == 2
    assert alone.posterior(state) == pytest.approx(wrapped.posterior(), abs=1e-4)


def test_agent_recovers_when_it_adapts(agent: FAMLE, make_env: MakeEnv) -> None:
    """The loop of the user: a robot whose base turns the wrong way reaches its goal all the same."""
    env = FAMLEWrapper(make_env(situation="joint 0 reversed"), agent)

    def episode() -> float:
        obs, _ = env.reset(seed=1)
        total, done = 0.0, False
        while not done:
            action, _ = agent.predict(obs)
            obs, reward, terminated, truncated, _ = env.step(action)
            total, done = total + reward, terminated or truncated
        return total

    episode()
    adapted = episode()
    agent.forget()
    agent.config = agent.config.changed(adapt_every=0)
    assert adapted > episode() + 5


def test_situation_may_change_in_the_middle(agent: FAMLE, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(make_env(), agent)
    run(env, 10)
    env.get_wrapper_attr("set_situation")("joint 0 reversed")
    for _ in range(2):
        infos = run(env, 49, seed=None)
    assert infos[-1]["famle"]["situation"] == "joint 0 reversed"


def test_agent_serves_one_wrapper_at_a_time(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    first, second = (FAMLEWrapper(make_env(), quick_agent) for _ in range(2))
    run(first, 2)
    run(second, 2)
    with pytest.raises(RuntimeError, match="taken over"):
        first.step(np.zeros(5))
    second.step(np.zeros(5))
    run(first, 2)
    with pytest.raises(RuntimeError, match="taken over"):
        second.step(np.zeros(5))


def test_agent_without_a_model_is_refused(make_env: MakeEnv) -> None:
    with pytest.raises(NotLearnedError, match=r"meta_learn\(\)"):
        FAMLEWrapper(make_env(), FAMLE(make_env(), device="cpu"))


def test_environment_with_other_spaces_is_refused(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    with pytest.raises(ValueError, match="are not the agent's"):
        FAMLEWrapper(make_env("Pendulum-v1"), quick_agent)


def test_step_needs_a_reset(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    with pytest.raises(gym.error.ResetNeeded, match=r"reset\(\)"):
        FAMLEWrapper(make_env(), quick_agent).step(np.zeros(5))


def test_sensor_that_fails_is_named(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    broken = gym.wrappers.TransformObservation(make_env(), lambda obs: obs * np.nan, None)
    env = FAMLEWrapper(broken, quick_agent)
    env.reset(seed=0)
    obs, _, _, _, info = env.step(np.zeros(5))
    assert info["famle"]["quarantined"] == 1
    with pytest.raises(SensorError, match="observation holds NaN"):
        quick_agent.predict(obs)


def test_environment_may_reuse_its_observation(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    buffer = np.zeros(12, dtype=np.float32)

    def reuse(obs: Any) -> Any:
        buffer[:] = obs
        return buffer

    env = FAMLEWrapper(gym.wrappers.TransformObservation(make_env(), reuse, None), quick_agent)
    obs, _ = env.reset(seed=0)
    first = obs.copy()
    env.step(np.ones(5))
    memory = quick_agent.state_of(1).memory
    np.testing.assert_array_equal(memory.obs[0, -1], first)
    assert not np.array_equal(memory.next_obs[0, -1], first)


def test_wrapped_environment_has_a_spec_and_passes_things_through(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(make_env(render_mode="rgb_array"), quick_agent)
    assert env.spec.id == "FamleReacher-v0"
    assert env.spec.additional_wrappers[-1].name == "FAMLEWrapper"
    assert env.spec.additional_wrappers[-1].kwargs["agent"] is quick_agent
    assert env.observation_space == quick_agent.observation_space
    env.reset(seed=0)
    assert env.render().shape == (480, 480, 3)


def test_nothing_in_the_info_is_shared_between_steps(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    infos = run(FAMLEWrapper(make_env(), quick_agent), 3)
    for name in ("famle", "posterior"):
        dicts = [info["famle"] if name == "famle" else info["famle"]["posterior"] for info in infos]
        assert len({id(one) for one in dicts}) == len(dicts)
    infos[0]["famle"]["posterior"].clear()
    assert len(quick_agent.posterior()) == 11


def test_evaluate_policy_on_the_wrapped_environment(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(make_env(situation="joint 3 dead"), quick_agent)
    mean, _ = evaluate_policy(quick_agent, env, n_eval_episodes=1, warn=False)
    assert 0 < mean <= 50
    assert quick_agent.belief.adaptations == 10


def test_pendulum_needs_no_situation(make_env: MakeEnv) -> None:
    agent = FAMLE(
        "Pendulum-v1",
        reward_fn=lambda obs, action, next_obs: next_obs[..., 0],
        seed=0,
        device="cpu",
        hidden=(8,),
        policy_steps=0,
        transitions_per_situation=30,
        meta_iterations=2,
        adapt_every=2,
    )
    agent.meta_learn([lambda g=g: gym.make("Pendulum-v1", g=g) for g in (3.0, 10.0)])
    infos = run(FAMLEWrapper(make_env("Pendulum-v1", g=5.0), agent), 4)
    assert infos[-1]["famle"]["situation"] in ("situation 0", "situation 1")
    assert infos[-1]["famle"]["adaptations"] == 2
