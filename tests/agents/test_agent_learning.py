from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from famle_agent import FAMLE, NotLearnedError, Transitions
from tests.helpers import run, some_observations

Array = npt.NDArray[Any]
Load = Callable[..., FAMLE]
MakeEnv = Callable[..., gym.Env[Any, Any]]


# --- learn --------------------------------------------------------------------------------------------------


class Recorder(BaseCallback):
    """Counts, and remembers how many steps were done when it began and ended."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[int] = []
        self.ended = False

    def _on_step(self) -> bool:
        self.calls.append(self.model.num_timesteps)
        return True

    def _on_training_end(self) -> None:
        self.ended = True


def test_learn_lives_and_adapts(quick_agent: FAMLE) -> None:
    recorder = Recorder()
    quick_agent.get_env().env_method("set_situation", "joint 3 dead")
    assert quick_agent.learn(60, callback=recorder) is quick_agent
    assert recorder.calls == list(range(1, 61))
    assert recorder.ended
    assert quick_agent.num_timesteps == 60
    assert quick_agent.belief.adaptations == 12
    assert max(quick_agent.posterior().items(), key=lambda item: item[1])[0] == "joint 3 dead"


def test_callbacks_are_told_what_off_policy_algorithms_tell_them(quick_agent: FAMLE) -> None:
    class Watcher(Recorder):
        def _on_rollout_start(self) -> None:
            self.calls.append(0)

        def _on_rollout_end(self) -> None:
            self.calls.append(-self.model.num_timesteps)
            assert {"new_obs", "rewards", "dones", "infos"} <= set(self.locals)
            assert self.locals["rewards"].shape == (1,)

    watcher = Watcher()
    quick_agent.learn(3, callback=watcher)
    assert watcher.calls == [0, 1, -1, 0, 2, -2, 0, 3, -3]


def test_robots_learn_from_the_last_transition_of_an_episode(quick_agent: FAMLE) -> None:
    """Robots whose episodes end at different steps, each where it did not begin the next one."""
    lengths = (3, 5)
    quick_agent.get_env().close()
    quick_agent.set_env(
        DummyVecEnv([lambda n=n: gym.make("FamleReacher-v0", max_episode_steps=n) for n in lengths])  # type: ignore[misc]
    )
    ends: list[tuple[int, Any]] = []

    def note(local: dict[str, Any], _: Any) -> bool:
        ends.extend((i, info["terminal_observation"]) for i, info in enumerate(local["infos"]) if local["dones"][i])
        return True

    quick_agent.learn(2 * 6, callback=note)
    memory = quick_agent.state_of(2).memory
    assert memory.seen == 6
    assert [i for i, _ in ends] == [0, 1, 0]
    for (robot, terminal), age in zip(ends, (4, 2, 1), strict=True):
        np.testing.assert_array_equal(memory.next_obs[robot, -age].numpy(), terminal)
        if age > 1:
            assert not torch.equal(memory.obs[robot, 1 - age], memory.next_obs[robot, -age])
    quick_agent.get_env().close()


def test_learning_goes_on_where_it_stopped(quick_agent: FAMLE) -> None:
    quick_agent.learn(10)
    quick_agent.learn(10, reset_num_timesteps=False)
    assert quick_agent.num_timesteps == 20
    assert quick_agent.belief.adaptations == 4


def test_function_that_returns_false_stops_learning(quick_agent: FAMLE) -> None:
    quick_agent.learn(50, callback=lambda local, _: local["self"].num_timesteps < 7)
    assert quick_agent.num_timesteps == 7


@pytest.mark.slow
def test_stable_baselines_callbacks_work(quick_agent: FAMLE, make_env: MakeEnv, tmp_path: Path) -> None:
    evaluation = EvalCallback(
        make_env(),
        eval_freq=10,
        n_eval_episodes=1,
        best_model_save_path=str(tmp_path / "best"),
        log_path=str(tmp_path / "log"),
        verbose=0,
        warn=False,
    )
    checkpoint = CheckpointCallback(10, save_path=str(tmp_path / "checkpoints"))
    quick_agent.learn(20, callback=[evaluation, checkpoint])
    assert np.load(tmp_path / "log" / "evaluations.npz")["timesteps"].tolist() == [10, 20]
    assert FAMLE.load(tmp_path / "best" / "best_model", device="cpu").belief.adaptations in (2, 4)
    saved = FAMLE.load(tmp_path / "checkpoints" / "rl_model_10_steps", device="cpu")
    assert saved.belief.adaptations == 2


def test_progress_bar(quick_agent: FAMLE, capsys: pytest.CaptureFixture[str]) -> None:
    quick_agent.learn(5, progress_bar=True)
    assert "5/5" in capsys.readouterr().out


def test_learn_meta_learns_first() -> None:
    agent = FAMLE("reacher", seed=0, device="cpu", transitions_per_situation=20, meta_iterations=2, candidates=5)
    agent.learn(3)
    assert len(agent.situations) == 11
    assert agent.num_timesteps == 3
    agent.get_env().close()


def test_learning_on_several_robots(quick_agent: FAMLE) -> None:
    quick_agent.get_env().close()
    quick_agent.set_env(DummyVecEnv([lambda: gym.make("FamleReacher-v0") for _ in range(2)]))
    assert quick_agent.n_envs == 2
    quick_agent.learn(24)
    assert quick_agent.num_timesteps == 24
    assert quick_agent.belief.posterior.shape == (2, 11)
    assert quick_agent.belief.adaptations == 2
    quick_agent.get_env().close()
    quick_agent.set_env(gym.make("FamleReacher-v0"))
    quick_agent.learn(6)
    assert quick_agent.belief.posterior.shape == (1, 11)


def test_environment_with_other_spaces_is_refused(quick_agent: FAMLE, make_env: MakeEnv) -> None:
    before = quick_agent.get_env()
    with pytest.raises(ValueError, match=r"[Ss]pace"):
        quick_agent.set_env(make_env("Pendulum-v1"))
    assert quick_agent.get_env() is before
    assert quick_agent.n_envs == 1


# --- meta_learn ---------------------------------------------------------------------------------------------


def meta_learned(transitions: Transitions, seed: int = 0, **overrides: Any) -> FAMLE:
    few = replace(transitions, **{n: getattr(transitions, n)[:, :50] for n in ("obs", "action", "reward", "next_obs")})
    agent = FAMLE("reacher", seed=seed, device="cpu", **{"meta_iterations": 5, "inner_steps": 3, **overrides})
    agent.get_env().close()
    return agent.meta_learn(few)


def test_same_seed_same_agent(transitions: Transitions) -> None:
    one = meta_learned(transitions)
    torch.manual_seed(99)
    np.random.seed(99)
    same, other = meta_learned(transitions), meta_learned(transitions, seed=1)
    obs = some_observations(transitions, 1)
    for _ in range(2):
        actions = [agent.predict(obs)[0] for agent in (one, same, other)]
        np.testing.assert_array_equal(actions[0], actions[1])
        assert not np.array_equal(actions[0], actions[2])
    for name, value in one.dynamics.state_dict().items():
        assert torch.equal(value, same.dynamics.state_dict()[name])


def test_collected_transitions_follow_the_seed() -> None:
    collected = []
    for seed in (3, 3, 4):
        agent = FAMLE("reacher", seed=seed, device="cpu", transitions_per_situation=5)
        collected.append(agent.collect(["intact", "joint 3 dead"]))
        agent.get_env().close()
    one, same, other = collected
    for name in ("obs", "action", "reward", "next_obs"):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert not np.array_equal(one.action, other.action)
    assert not np.array_equal(one.action[0], one.action[1])


def test_meta_learning_leaves_the_global_generators_alone(transitions: Transitions) -> None:
    agent = FAMLE("reacher", seed=0, device="cpu", meta_iterations=2, inner_steps=2, candidates=5)
    agent.get_env().close()
    state = torch.get_rng_state()
    agent.meta_learn(transitions)
    agent.predict(some_observations(transitions, 1))
    assert torch.equal(torch.get_rng_state(), state)


def test_interrupted_meta_learning_leaves_the_agent_as_it_was(quick_agent: FAMLE) -> None:
    situations, model, posterior = quick_agent.situations, quick_agent.dynamics, quick_agent.posterior()

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        quick_agent.meta_learn(["intact", "joint 1 dead"], callback=interrupt)
    assert quick_agent.situations == situations
    assert quick_agent.dynamics is model
    assert quick_agent.posterior() == posterior


def test_callback_counts_the_meta_iterations_and_stops_them(transitions: Transitions) -> None:
    recorder = Recorder()
    agent = FAMLE("reacher", seed=0, device="cpu", meta_iterations=4, inner_steps=1)
    agent.get_env().close()
    agent.meta_learn(transitions, callback=recorder)
    assert recorder.n_calls == agent.num_iterations == 4
    assert recorder.calls == [0, 0, 0, 0]  # the robot has not moved
    assert recorder.ended
    calls: list[int] = []
    agent.meta_learn(transitions, callback=lambda local, _: calls.append(1) or len(calls) < 2)
    assert len(calls) == 2
    assert agent.num_timesteps == 0


def test_meta_learning_again_forgets_the_robot(quick_agent: FAMLE, transitions: Transitions) -> None:
    for i in range(5):
        quick_agent.observe(transitions.obs[3, i], transitions.action[3, i], transitions.next_obs[3, i])
    assert quick_agent.belief.adaptations == 1
    quick_agent.config = quick_agent.config.changed(meta_iterations=1)
    quick_agent.meta_learn(transitions)
    assert quick_agent.belief.adaptations == 0


@pytest.mark.parametrize("mode", ["ours", "paper"])
@pytest.mark.parametrize("planner", ["icem", "mppi", "random_shooting"])
def test_every_mode_and_planner_runs(transitions: Transitions, make_env: MakeEnv, mode: str, planner: str) -> None:
    agent = FAMLE(
        "reacher",
        mode,
        seed=0,
        device="cpu",
        planner=planner,
        candidates=20,
        inner_steps=2,
        meta_iterations=3,
    )
    agent.meta_learn(transitions)
    agent.get_env().close()
    assert run(agent, make_env(), steps=11).belief.adaptations == 10 // agent.config.adaptation.every


def test_transitions_of_another_robot_are_refused(transitions: Transitions) -> None:
    agent = FAMLE("Pendulum-v1", seed=0, device="cpu")
    with pytest.raises(ValueError, match="The transitions have observations"):
        agent.meta_learn(transitions)


def test_agent_without_a_model_says_what_to_do(transitions: Transitions) -> None:
    agent = FAMLE("reacher", device="cpu")
    obs, action = transitions.obs[0, 0], transitions.action[0, 0]
    for call in (
        lambda: agent.predict(obs),
        lambda: agent.observe(obs, action, obs),
        agent.posterior,
        lambda: agent.belief,
    ):
        with pytest.raises(NotLearnedError, match=r"meta_learn\(\)"):
            call()
    agent.forget()
    agent.begin_episode()
    agent.get_env().close()


# --- parameters ---------------------------------------------------------------------------------------------


def test_parameters_can_be_taken_and_given(load_agent: Load, transitions: Transitions) -> None:
    one, other = load_agent(), load_agent()
    with torch.no_grad():
        for value in other.dynamics.parameters():
            value.add_(0.1)
    obs = some_observations(transitions, 1)
    before = other.predict(obs, deterministic=True)[0]
    assert list(one.get_parameters()) == ["dynamics"]
    other.set_parameters(one.get_parameters())
    after = other.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(after, one.predict(obs, deterministic=True)[0])
    assert not np.array_equal(before, after)


def test_seeding_again_repeats_the_actions(quick_agent: FAMLE, transitions: Transitions) -> None:
    obs, actions = some_observations(transitions, 1), []
    for seed in (5, 5, 6, None):
        quick_agent.set_random_seed(seed)
        actions.append(quick_agent.predict(obs)[0])
    np.testing.assert_array_equal(actions[0], actions[1])
    assert not np.array_equal(actions[0], actions[2])
    assert not np.array_equal(actions[2], actions[3])
