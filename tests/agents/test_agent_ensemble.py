from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import DummyVecEnv

from famle_agent import FAMLE, FAMLEWrapper, Transitions
from famle_agent.adaptation.candidates import Candidates
from tests.helpers import run, some_observations

MakeEnv = Callable[..., gym.Env[Any, Any]]
Reload = Callable[..., FAMLE]
TINY: dict[str, Any] = {
    "hidden": (16,),
    "members": 2,
    "interaction_rank": 2,
    "degrees_of_freedom": 3.0,
    "joint_iterations": 150,
    "joint_lr": 0.01,
    "joint_embedding_lr": 0.03,
    "joint_batch_size": 128,
    "meta_iterations": 0,
    "compose": True,
    "adapt_every": 2,
    "adapt_steps": 2,
    "adapt_batch_size": 0,
    "memory_size": 20,
    "horizon": 4,
    "candidates": 12,
    "planner_iterations": 1,
    "elites": 4,
}
N_CANDIDATES = 11 + 10 * 9 // 2


@pytest.fixture(scope="module")
def ensemble_file(transitions: Transitions, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An agent of two members that composes faults, for the reacher."""
    agent = FAMLE("reacher", seed=0, device="cpu", **TINY)
    path = tmp_path_factory.mktemp("ensemble") / "reacher.zip"
    agent.meta_learn(transitions).save(path)
    agent.get_env().close()
    return path


@pytest.fixture
def load(ensemble_file: Path) -> Iterator[Callable[..., FAMLE]]:
    agents: list[FAMLE] = []

    def load_agent(file: Any = ensemble_file, **overrides: Any) -> FAMLE:
        agents.append(FAMLE.load(file, device="cpu", **overrides))
        return agents[-1]

    yield load_agent
    for agent in agents:
        agent.get_env().close()


@pytest.fixture
def ensemble(load: Callable[..., FAMLE]) -> FAMLE:
    return load()


def tell(agent: FAMLE, transitions: Transitions, situation: int, n: int) -> None:
    for i in range(n):
        agent.observe(
            transitions.obs[situation, i], transitions.action[situation, i], transitions.next_obs[situation, i]
        )


def saved(agent: FAMLE) -> io.BytesIO:
    buffer = io.BytesIO()
    agent.save(buffer)
    buffer.seek(0)
    return buffer


# --- what it believes ---------------------------------------------------------------------------------------


def test_posterior_names_pairs_and_marginals_name_situations(ensemble: FAMLE, transitions: Transitions) -> None:
    posterior, marginals = ensemble.posterior(), ensemble.marginals()
    assert len(posterior) == N_CANDIDATES
    assert "joint 0 dead + joint 3 dead" in posterior
    assert not [name for name in posterior if "intact +" in name]
    assert tuple(marginals) == ensemble.situations
    tell(ensemble, transitions, ensemble.situations.index("joint 3 dead"), 20)
    posterior, marginals = ensemble.posterior(), ensemble.marginals()
    assert sum(posterior.values()) == pytest.approx(1.0, abs=1e-5)
    assert max(marginals, key=lambda name: marginals[name]) == "joint 3 dead"
    for name, value in marginals.items():
        parts = [p for label, p in posterior.items() if name in label.split(" + ")]
        assert value == pytest.approx(sum(parts), abs=1e-5)


def test_without_composition_posterior_and_marginals_are_the_same(load: Callable[..., FAMLE]) -> None:
    agent = load(compose=False)
    assert agent.posterior() == pytest.approx(agent.marginals())
    assert len(agent.posterior()) == 11


def test_beliefs_of_a_state_are_not_those_of_the_agent(ensemble: FAMLE, make_env: MakeEnv) -> None:
    state = run(ensemble, make_env(situation="joint 3 dead"), steps=15)
    assert ensemble.marginals(state) != ensemble.marginals()
    assert ensemble.marginals(state)["joint 3 dead"] > ensemble.marginals()["joint 3 dead"]


def test_wrapper_tells_what_is_most_likely(ensemble: FAMLE, make_env: MakeEnv) -> None:
    env = FAMLEWrapper(make_env(), ensemble)
    obs, info = env.reset(seed=0)
    assert len(info["famle"]["posterior"]) == N_CANDIDATES
    *_, info = env.step(ensemble.predict(obs)[0])
    assert info["famle"]["situation"] in ensemble.posterior()


def test_candidates_follow_the_parameters(load: Callable[..., FAMLE], transitions: Transitions) -> None:
    one, other = load(), load()
    one.posterior()
    with torch.no_grad():
        for value in other.dynamics.parameters():
            value.mul_(0.5)
    one.set_parameters(other.get_parameters())
    for agent in (one, other):
        tell(agent, transitions, 3, 4)
    assert one.posterior() == pytest.approx(other.posterior())
    assert torch.equal(one.belief.h, other.belief.h)


def test_candidates_follow_what_is_learnt(transitions: Transitions) -> None:
    """Asked for them in the middle of the learning, an agent does not keep the answer."""
    agent = FAMLE("reacher", seed=0, device="cpu", **{**TINY, "joint_iterations": 4})
    agent.get_env().close()
    agent.meta_learn(transitions, callback=lambda local, _: bool(local["self"].posterior()))
    expected = Candidates.of(agent.dynamics, compose=True)
    torch.testing.assert_close(agent.candidates.h, expected.h)


def test_candidates_follow_the_settings(ensemble: FAMLE) -> None:
    assert len(ensemble.posterior()) == N_CANDIDATES
    ensemble.config = ensemble.config.changed(compose=False)
    assert len(ensemble.posterior()) == 11


# --- how it lives -------------------------------------------------------------------------------------------


def test_robots_of_an_ensemble_live_as_each_would_alone(ensemble: FAMLE, transitions: Transitions) -> None:
    states: list[Any] = [None] * 4
    rows = [slice(0, 3), slice(0, 1), slice(1, 2), slice(2, 3)]
    for i in range(7):
        obs = transitions.obs[[0, 3, 8], i]
        for k, robots in enumerate(rows):
            if states[k] is None:
                _, states[k] = ensemble.predict(obs[robots])
            last = (states[k].last[0], torch.from_numpy(transitions.action[[0, 3, 8], i][robots]))
            states[k] = replace(states[k], last=last)
            following = transitions.next_obs[[0, 3, 8], i][robots]
            _, states[k] = ensemble.predict(following, states[k])
            states[k] = replace(states[k], last=(torch.from_numpy(following), states[k].last[1]))
    together = states[0]
    assert together.belief.adaptations == 3
    assert together.belief.h.shape[:2] == (3, 2)
    for robot in range(3):
        alone = states[1 + robot]
        torch.testing.assert_close(
            alone.belief.log_posterior[0], together.belief.log_posterior[robot], rtol=1e-3, atol=1e-2
        )
        torch.testing.assert_close(alone.belief.h, together.belief.h[robot : robot + 1], rtol=1e-3, atol=1e-3)
        for name, value in alone.belief.theta.items():
            own = together.belief.theta[name][robot : robot + 1]
            torch.testing.assert_close(value, own, rtol=1e-3, atol=1e-3)


def test_ensemble_learns_on_several_robots(load: Callable[..., FAMLE]) -> None:
    agent = load()
    agent.get_env().close()
    agent.set_env(DummyVecEnv([lambda: gym.make("FamleReacher-v0") for _ in range(3)]))
    agent.learn(15)
    assert agent.belief.posterior.shape == (3, N_CANDIDATES)
    assert agent.belief.adaptations == 2
    assert agent.belief.h.shape == (3, 2, 5)


# --- saving and loading -------------------------------------------------------------------------------------


def test_ensemble_acts_as_the_saved_one(load: Callable[..., FAMLE], ensemble: FAMLE, transitions: Transitions) -> None:
    tell(ensemble, transitions, 3, 5)
    loaded = load(saved(ensemble))
    assert loaded.config == ensemble.config
    assert loaded.posterior() == ensemble.posterior()
    for name, value in ensemble.dynamics.state_dict().items():
        assert torch.equal(loaded.dynamics.state_dict()[name], value)
    for agent in (loaded, ensemble):
        tell(agent, transitions, 3, 3)
        assert agent.belief.adaptations == 4
    assert loaded.posterior() == ensemble.posterior()
    obs = some_observations(transitions, 1)[0]
    for _ in range(2):
        np.testing.assert_array_equal(loaded.predict(obs)[0], ensemble.predict(obs)[0])


@pytest.mark.parametrize("changed", [{"compose": False}, {"compose": False, "memory_size": 3, "horizon": 2}])
def test_composition_can_be_changed_where_the_agent_has_lived(
    load: Callable[..., FAMLE], ensemble: FAMLE, transitions: Transitions, changed: dict[str, Any]
) -> None:
    tell(ensemble, transitions, 3, 5)
    with pytest.warns(UserWarning, match="left behind"):
        loaded = load(saved(ensemble), **changed)
    assert loaded.posterior() == pytest.approx(dict.fromkeys(loaded.situations, 1 / 11))
    tell(loaded, transitions, 3, 4)
    loaded.predict(some_observations(transitions, 1)[0])
    assert len(loaded.posterior()) == 11
    back = load(saved(loaded), compose=True)
    assert len(back.posterior()) == N_CANDIDATES
    tell(back, transitions, 3, 4)


def test_quaternions_survive() -> None:
    env = gym.make("FamleAnt-v0")
    agent = FAMLE(
        env,
        seed=0,
        device="cpu",
        pretrained=False,
        **TINY | {"rounds": 0, "transitions_per_situation": 8, "joint_iterations": 2},
    )
    agent.meta_learn(["intact", "joint 3 dead", "joint 4 dead"])
    loaded = FAMLE.load(saved(agent), device="cpu")
    assert loaded.dims["quaternion_dims"] == (1, 2, 3, 4)
    assert loaded.dynamics.layout.quaternion_dims == (1, 2, 3, 4)
    obs, _ = env.reset(seed=0)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], agent.predict(obs, deterministic=True)[0])
    for one in (agent, loaded):
        one.get_env().close()
    bare = FAMLE.load(saved(agent), env=None, device="cpu", quaternion_dims=(1, 2, 3, 4))
    assert bare.dynamics.n_features == loaded.dynamics.n_features
    bare.get_env().close()
    with pytest.raises(ValueError, match="an override changed the network"):
        FAMLE.load(saved(agent), device="cpu", quaternion_dims=())
