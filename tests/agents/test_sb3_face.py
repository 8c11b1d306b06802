"""What somebody who knows Stable-Baselines3 tries first."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import LogEveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from famle_agent import AMPCMAML, FAMLE, FAMLEWrapper, Transitions
from famle_agent.adaptation.adapters import EmbeddingAdapter

MakeEnv = Callable[..., gym.Env[Any, Any]]
Load = Callable[..., FAMLE]

FAST: dict[str, Any] = {"adapt_every": 5, "adapt_steps": 1, "candidates": 4, "planner_iterations": 1}
TINY: dict[str, Any] = {**FAST, "hidden": (8,), "joint_iterations": 2, "meta_iterations": 2, "inner_steps": 2}


class Recorded(KVWriter):
    """Keeps what is logged."""

    def __init__(self) -> None:
        self.rows: dict[int, dict[str, Any]] = {}

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.rows[step] = dict(key_values)

    def close(self) -> None:
        pass


class AtTheGoal(gym.Wrapper):
    """Says at the end of an episode that the goal was reached."""

    def step(self, action: Any) -> Any:
        *rest, info = self.env.step(action)
        return *rest, {**info, "is_success": True}


@pytest.fixture
def fast(load_agent: Load) -> FAMLE:
    """An agent whose episodes have 5 steps."""
    agent = load_agent(**FAST)
    agent.get_env().close()
    agent.set_env(gym.make("FamleReacher-v0", max_episode_steps=5))
    return agent


def recorded(agent: FAMLE) -> Recorded:
    writer = Recorded()
    agent.set_logger(Logger(None, [writer]))
    return writer


def same_weights(one: FAMLE, other: FAMLE) -> bool:
    ours, theirs = one.get_parameters(), other.get_parameters()
    return ours.keys() == theirs.keys() and all(
        torch.equal(value, theirs[network][name]) for network, state in ours.items() for name, value in state.items()
    )


# --- logging ------------------------------------------------------------------------------------------------


def test_logs_come_at_each_interval_of_steps_or_not_at_all(fast: FAMLE) -> None:
    writer = recorded(fast)
    fast.learn(10, log_interval=None)
    assert writer.rows == {}
    fast.learn(10, callback=LogEveryNTimesteps(4), log_interval=None)
    assert list(writer.rows) == [4, 8]


def test_logs_have_the_names_of_stable_baselines(fast: FAMLE) -> None:
    fast.set_env(AtTheGoal(gym.make("FamleReacher-v0", max_episode_steps=5)))
    writer = recorded(fast)
    fast.learn(10)
    last = writer.rows[10]
    assert last["rollout/success_rate"] == 1.0
    assert last["rollout/ep_len_mean"] == 5
    assert last["time/total_timesteps"] == 10
    assert last["time/episodes"] == 2
    assert last["time/fps"] > 0
    assert last["time/time_elapsed"] >= 0
    assert 0.0 <= last["posterior/joint 3 dead"] <= 1.0


def test_log_interval_that_is_no_number_of_episodes_is_refused(fast: FAMLE) -> None:
    with pytest.raises(ValueError, match="log_interval"):
        fast.learn(10, log_interval=0)


def test_logs_before_anything_is_learnt_are_refused(load_agent: Load) -> None:
    with pytest.raises(ValueError, match="no logger yet"):
        load_agent().dump_logs()


def test_steps_of_robots_and_of_gradients_are_counted_apart(transitions: Transitions) -> None:
    agent = FAMLE("reacher", seed=0, device="cpu", **TINY)
    writer = recorded(agent)
    agent.meta_learn(transitions)
    assert agent.num_timesteps == 0
    assert agent.num_iterations == writer.rows[4]["time/iterations"] == 4
    agent.learn(3)
    assert (agent.num_timesteps, agent.num_iterations) == (3, 4)


def test_progress_bars_stand_alone_on_the_console(
    transitions: Transitions, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    agent = FAMLE("reacher", seed=0, device="cpu", verbose=1, tensorboard_log=str(tmp_path), **TINY)
    agent.meta_learn(transitions, progress_bar=True)
    shown = capsys.readouterr()
    assert "Meta-learning" in shown.err
    assert "loss_after" not in shown.out
    assert list(tmp_path.rglob("events*"))
    agent.meta_learn(transitions)
    assert "loss_after" in capsys.readouterr().out


# --- making, saving and loading -----------------------------------------------------------------------------


def test_policy_may_be_named(make_env: MakeEnv) -> None:
    assert FAMLE(policy="MlpPolicy", env=make_env(), device="cpu").observation_space.shape == (12,)
    with pytest.raises(ValueError, match="policy='MlpPolicy'"):
        FAMLE("MlpPolicy", make_env())
    with pytest.raises(ValueError, match="CnnPolicy"):
        FAMLE(make_env(), policy="CnnPolicy")


def test_monitor_and_window_of_the_statistics(load_agent: Load) -> None:
    env = gym.make("FamleReacher-v0", max_episode_steps=2)
    agent = load_agent(**FAST, stats_window_size=3, monitor_wrapper=False)
    agent.set_env(env)
    assert not agent.get_env().env_is_wrapped(Monitor)[0]
    agent.set_env(Monitor(env))
    agent.learn(8)
    assert len(agent.ep_info_buffer) == 3


def test_loaded_agent_keeps_where_it_prints_and_logs(transitions: Transitions, tmp_path: Path) -> None:
    agent = FAMLE("reacher", device="cpu", verbose=1, tensorboard_log=str(tmp_path / "logs"))
    agent.save(tmp_path / "agent.zip")
    loaded = FAMLE.load(tmp_path / "agent.zip")
    assert (loaded.verbose, loaded.tensorboard_log) == (1, str(tmp_path / "logs"))
    quiet = FAMLE.load(tmp_path / "agent.zip", verbose=0, tensorboard_log=None)
    assert (quiet.verbose, quiet.tensorboard_log) == (0, None)


def test_load_takes_what_stable_baselines_does(agent_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    objects = {"seed": 7, "adapt_every": 9, "lr_schedule": None}
    loaded = FAMLE.load(agent_file, custom_objects=objects, print_system_info=True, force_reset=False)
    assert (loaded.seed, loaded.config.adaptation.every) == (7, 9)
    assert "PyTorch" in capsys.readouterr().out


def test_file_goes_without_what_is_excluded(fast: FAMLE) -> None:
    def after_saving(**how: Any) -> FAMLE:
        buffer = io.BytesIO()
        fast.save(buffer, **how)
        buffer.seek(0)
        return FAMLE.load(buffer, device="cpu")

    fast.learn(10)
    assert after_saving(include=["live"]).belief.adaptations == 2
    forgetful = after_saving(exclude=["live", "num_timesteps", "replay_buffer"])
    assert forgetful.belief.adaptations == forgetful.num_timesteps == 0
    assert same_weights(forgetful, fast)
    assert after_saving(exclude=["live"], include=["live"]).belief.adaptations == 2
    with pytest.raises(ValueError, match="observation_space"):
        after_saving(exclude=["observation_space"])
    with pytest.raises(ValueError, match="can hold no replay_buffer"):
        after_saving(include=["replay_buffer"])


def test_new_agent_takes_parameters_from_a_file_and_from_an_agent(agent_file: Path, agent: FAMLE) -> None:
    settings = {"config": agent.config, "device": "cpu"}
    for source in (agent_file, str(agent_file), agent.get_parameters()):
        new = FAMLE("reacher", **settings)
        assert new.get_parameters() == {}
        new.set_parameters(source)
        assert same_weights(new, agent)
        assert new.situations == agent.situations
        new.predict(np.zeros(12, np.float32))


def test_parameters_that_do_not_fit_change_nothing(agent: FAMLE, agent_file: Path) -> None:
    before = {name: value.clone() for name, value in agent.get_parameters()["dynamics"].items()}
    wrong = {**before, "embeddings": before["embeddings"][..., :-1]}
    short = {name: value + 1 for name, value in before.items() if name != "embeddings"}
    for given, message in (
        ({"dynamics": wrong}, "do not fit"),
        ({"dynamics": short}, "do not fit"),
        ({"actor": before}, "no network actor"),
        ({}, "exact_match=False"),
    ):
        with pytest.raises(ValueError, match=message):
            agent.set_parameters(given)
    with pytest.raises(ValueError, match=r"FAMLE\.load"):
        AMPCMAML("reacher", device="cpu").set_parameters(agent_file)
    after = agent.get_parameters()["dynamics"]
    assert all(torch.equal(after[name], value) for name, value in before.items())
    agent.set_parameters({"dynamics": {"embeddings": before["embeddings"] + 1}}, exact_match=False)
    assert torch.equal(agent.dynamics.embeddings, before["embeddings"] + 1)


# --- robots -------------------------------------------------------------------------------------------------


def test_rewards_may_be_normalised_but_no_observations(load_agent: Load) -> None:
    robots = DummyVecEnv([lambda: gym.make("FamleReacher-v0", max_episode_steps=5)])
    agent = FAMLE(VecNormalize(robots, norm_obs=False), device="cpu", transitions_per_situation=20, **TINY)
    agent.meta_learn().learn(10)
    assert agent.belief.adaptations == 2
    with pytest.raises(ValueError, match="norm_obs=False"):
        agent.set_env(VecNormalize(robots))


def test_each_robot_has_its_own_belief(load_agent: Load) -> None:
    agent = load_agent(**{**FAST, "adapt_every": 10})
    wrongs = ("intact", "joint 3 dead", "joint 0 reversed")
    agent.set_env(DummyVecEnv([lambda wrong=wrong: gym.make("FamleReacher-v0", situation=wrong) for wrong in wrongs]))
    agent.learn(90)
    for robot in range(3):
        posterior = agent.posterior(robot=robot)
        assert max(posterior, key=lambda name: posterior[name]) == agent.diagnose(robot=robot).situation
        assert agent.marginals(robot=robot) == pytest.approx(posterior)
    assert len({agent.diagnose(robot=robot).situation for robot in range(3)}) > 1
    assert agent.posterior() == agent.posterior(robot=0)
    for ask in (agent.posterior, agent.marginals, agent.diagnose):
        with pytest.raises(IndexError, match="robots 0 to 2, not 3"):
            ask(robot=3)


@pytest.mark.slow
def test_processes_of_a_notebook_know_robots_by_the_name_of_their_package(fast: FAMLE) -> None:
    """A process that is spawned has imported nothing."""
    kwargs = {"start_method": "spawn"}
    robots = make_vec_env("famle_envs:FamleReacher-v0", 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=kwargs)
    try:
        fast.set_env(robots)
        fast.learn(20)
        assert fast.belief.adaptations == 2
    finally:
        robots.close()


def test_an_id_that_nobody_knows_is_answered_with_the_package_in_front() -> None:
    with pytest.raises(ValueError, match="'famle_envs:FamleAnt-v0'"):
        FAMLE("FamleElephant-v0")


def test_driver_of_a_real_robot_is_answered_with_the_loop_for_it(fast: FAMLE) -> None:
    class Driver:
        def send(self, action: Any) -> None: ...

    for give in (FAMLE, fast.set_env, lambda driver: FAMLEWrapper(driver, fast)):
        with pytest.raises(TypeError, match=r"got a Driver.*FAMLE\.load.*predict.*observe"):
            give(Driver())


def test_what_is_known_of_many_robots_is_of_none_alone(fast: FAMLE) -> None:
    fast.set_env(DummyVecEnv([lambda: gym.make("FamleReacher-v0", max_episode_steps=5)] * 3))
    fast.learn(30)
    _, many = fast.predict(np.zeros((3, 12), np.float32))
    _, single = fast.predict(np.zeros(12, np.float32))
    assert many.belief.adaptations == 2
    assert single.belief.adaptations == 0
    assert list(fast.posterior(single).values()) == pytest.approx([1 / 11] * 11)


def test_wrapped_robot_adapts_once_a_step_in_any_loop(
    load_agent: Load, make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, adapt = [], EmbeddingAdapter.adapt

    def counted(self: EmbeddingAdapter, memory: Any, belief: Any, deadline: Any) -> Any:
        calls.append(belief)
        return adapt(self, memory, belief, deadline)

    agent = load_agent(**FAST)
    env = FAMLEWrapper(make_env(max_episode_steps=10), agent)
    monkeypatch.setattr(EmbeddingAdapter, "adapt", counted)
    evaluate_policy(agent, env, n_eval_episodes=2, warn=False)
    assert len(calls) == agent.belief.adaptations == 4


def test_state_of_a_wrapped_robot_believes_what_the_agent_does(load_agent: Load, make_env: MakeEnv) -> None:
    agent = load_agent(**FAST)
    env = FAMLEWrapper(make_env(situation="joint 3 dead"), agent)
    obs, state = env.reset(seed=0)[0], None
    for _ in range(7):
        action, state = agent.predict(obs, state)
        obs, *_ = env.step(action)
    _, state = agent.predict(obs, state)
    assert state.memory.weight.sum() == 7
    assert agent.posterior(state) == agent.posterior()


def test_state_of_another_robot_is_its_own(load_agent: Load, make_env: MakeEnv) -> None:
    agent = load_agent(**FAST)
    wrapped, other = FAMLEWrapper(make_env(), agent), make_env(situation="joint 3 dead")
    wrapped.reset(seed=0)
    obs, state = other.reset(seed=1)[0], None
    for _ in range(4):
        wrapped.step(np.ones(5, np.float32))
        action, state = agent.predict(obs, state)
        obs, *_ = other.step(action)
    _, state = agent.predict(obs, state)
    assert not torch.equal(state.memory.obs, agent.state_of(1).memory.obs)


def test_spec_with_an_agent_says_how_to_store_it(fast: FAMLE, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(make_env(), fast)
    with pytest.raises(TypeError, match=r"agent\.save"):
        env.spec.to_json()
    assert json.loads(env.env.spec.to_json())["id"] == "FamleReacher-v0"
    again = gym.make(env.spec)
    assert isinstance(again, FAMLEWrapper)
    again.close()
