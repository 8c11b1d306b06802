from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from famle_agent import AMPC, AMPCMAML, FAMLE, FAMLEWrapper, ModelBasedAgent, NotLearnedError, Transitions
from famle_agent.models.dynamics import Batch
from tests.helpers import run

MakeEnv = Callable[..., gym.Env[Any, Any]]
Load = Callable[..., ModelBasedAgent]
META: dict[str, Any] = {"inner_steps": 5, "batch_size": 16, "meta_batch_size": 11}
KINDS: dict[str, tuple[type[ModelBasedAgent], dict[str, Any]]] = {
    "ampc": (AMPC, {}),
    "reptile": (AMPCMAML, {**META, "meta_iterations": 60}),
    "first-order-maml": (
        AMPCMAML,
        {**META, "meta_learner": "first-order-maml", "meta_iterations": 80, "query_size": 16},
    ),
    "maml": (AMPCMAML, {**META, "meta_learner": "maml", "meta_iterations": 80, "query_size": 16}),
}
TINY: dict[str, Any] = {
    "device": "cpu",
    "transitions_per_situation": 60,
    "action_hold": 5,
    "hidden": (16,),
    "adapt_every": 2,
    "adapt_steps": 3,
    "adapt_lr": 0.01,
    "adapt_batch_size": 0,
    "memory_size": 20,
    "planner": "random_shooting",
    "horizon": 3,
    "candidates": 10,
}
HALVES = (slice(0, 30), slice(30, 60))
EVERYTHING = {"every situation": 1.0}
every_kind = pytest.mark.parametrize("kind", KINDS)


def make(kind: str, env: Any = "reacher", seed: int | None = 0, **overrides: Any) -> ModelBasedAgent:
    cls, own = KINDS[kind]
    return cls(env, seed=seed, **{**TINY, **own, **overrides})


@pytest.fixture(scope="module")
def data() -> Transitions:
    """A few random transitions of each of the reacher's training situations."""
    return collected(seed=0)


@pytest.fixture(scope="module")
def unseen() -> Transitions:
    """Others, which no agent has learnt from."""
    return collected(seed=1)


def collected(seed: int) -> Transitions:
    agent = make("ampc", seed=seed)
    transitions = agent.collect()
    agent.get_env().close()
    return transitions


@pytest.fixture(scope="module")
def files(data: Transitions, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One small agent of each kind."""
    folder, paths = tmp_path_factory.mktemp("rivals"), {}
    for kind in KINDS:
        agent, paths[kind] = make(kind), folder / f"{kind}.zip"
        agent.meta_learn(data).save(paths[kind])
        agent.get_env().close()
    return paths


@pytest.fixture
def load(files: dict[str, Path]) -> Iterator[Load]:
    """Loads fresh copies of the small agents, with settings changed."""
    agents: list[ModelBasedAgent] = []

    def load_agent(kind: str, file: Any = None, **overrides: Any) -> ModelBasedAgent:
        agents.append(KINDS[kind][0].load(file or files[kind], device="cpu", **overrides))
        return agents[-1]

    yield load_agent
    for agent in agents:
        agent.get_env().close()


def tell(agent: ModelBasedAgent, data: Transitions, n: int, first: int = 0, situation: int = 3) -> None:
    for i in range(first, first + n):
        agent.observe(data.obs[situation, i], data.action[situation, i], data.next_obs[situation, i])


def saved(agent: ModelBasedAgent) -> io.BytesIO:
    buffer = io.BytesIO()
    agent.save(buffer)
    buffer.seek(0)
    return buffer


def theta_of(agent: ModelBasedAgent) -> torch.Tensor:
    """All parameters of what an agent believes, one row a robot and member."""
    belief = agent.belief
    return torch.cat([value.flatten(0, 1).flatten(1) for _, value in sorted(belief.theta.items())], dim=1)


# --- the face of an agent ---------------------------------------------------------------------------------


@every_kind
def test_lives_as_any_agent_does(load: Load, data: Transitions, kind: str) -> None:
    agent = load(kind)
    action, state = agent.predict(data.obs[0, 0])
    assert agent.action_space.contains(action)
    assert agent.predict(data.obs[:3, 0])[0].shape == (3, 5)
    for i in range(1, 6):
        action, state = agent.predict(data.obs[0, i], state)
    assert state.belief.adaptations == 2
    assert state.memory.weight.sum() == 5
    assert agent.belief.adaptations == 0  # the memory is in the state, not in the agent
    assert agent.posterior() == agent.posterior(state) == agent.marginals() == agent.marginals(state) == EVERYTHING


@every_kind
def test_learns_on_the_robot_and_forgets_what_it_learnt(load: Load, kind: str) -> None:
    agent = load(kind)
    before = theta_of(agent)
    agent.learn(9)
    assert agent.num_timesteps == 9
    assert agent.belief.adaptations == 4
    assert not torch.equal(theta_of(agent), before)
    agent.forget()
    assert agent.belief.adaptations == 0
    assert torch.equal(theta_of(agent), before)


@every_kind
def test_evaluate_policy_adapts_without_a_wrapper(load: Load, make_env: MakeEnv, kind: str) -> None:
    counts: list[int] = []
    env = make_env(situation="joint 3 dead", max_episode_steps=8)

    def count(local: dict[str, Any], _: dict[str, Any]) -> None:
        counts.append(local["states"].belief.adaptations)

    mean, _ = evaluate_policy(load(kind), env, n_eval_episodes=1, warn=False, callback=count)
    assert counts == [0, 0, 1, 1, 2, 2, 3, 3]
    assert 0 < mean <= 8


@every_kind
def test_wrapper_adapts_it_and_knows_but_one_situation(load: Load, make_env: MakeEnv, kind: str) -> None:
    agent = load(kind)
    env = FAMLEWrapper(make_env(situation="joint 3 dead"), agent)
    obs, info = env.reset(seed=0)
    expected = {"situation": "every situation", "probability": 1.0, "posterior": EVERYTHING}
    expected |= {"diverged": 0, "recognised": False}
    expected |= dict.fromkeys(("quarantined", "blind", "dropped", "repeated", "overruns", "cut_short", "left_out"), 0)
    assert info["famle"] == expected | {"adaptations": 0}
    for _ in range(4):
        obs, *_, info = env.step(agent.predict(obs)[0])
    assert info["famle"] == expected | {"adaptations": 2}


@every_kind
def test_robots_of_a_vec_env_adapt_each_by_itself(load: Load, data: Transitions, kind: str) -> None:
    together, alone = load(kind), [load(kind) for _ in range(2)]
    for i in range(6):
        together.observe(data.obs[[1, 7], i], data.action[[1, 7], i], data.next_obs[[1, 7], i])
    for robot, situation in enumerate((1, 7)):
        tell(alone[robot], data, 6, situation=situation)
        torch.testing.assert_close(theta_of(alone[robot])[0], theta_of(together)[robot], rtol=1e-3, atol=1e-4)
    assert together.belief.adaptations == 3
    assert not torch.allclose(theta_of(together)[0], theta_of(together)[1], atol=1e-3)


@every_kind
def test_environment_may_be_exchanged_for_one_with_more_robots(load: Load, kind: str) -> None:
    agent = load(kind)
    agent.get_env().close()
    agent.set_env(DummyVecEnv([lambda: gym.make("FamleReacher-v0") for _ in range(2)]))
    agent.learn(10)
    assert agent.num_timesteps == 10
    assert agent.belief.adaptations == 2
    assert len(theta_of(agent)) == 2


@every_kind
@pytest.mark.parametrize("batch_size", [0, 4])
def test_loaded_agent_acts_as_the_saved_one(load: Load, data: Transitions, kind: str, batch_size: int) -> None:
    """Also where the transitions of its gradient steps are drawn."""
    agent = load(kind, adapt_batch_size=batch_size)
    tell(agent, data, 5)
    loaded = load(kind, saved(agent))
    assert loaded.config == agent.config
    assert loaded.situations == agent.situations == data.situations
    for one in (agent, loaded):
        tell(one, data, 3, first=5)
        assert one.belief.adaptations == 4
    assert torch.equal(theta_of(loaded), theta_of(agent))
    for i in range(2):
        np.testing.assert_array_equal(loaded.predict(data.obs[0, i])[0], agent.predict(data.obs[0, i])[0])


@every_kind
def test_same_seed_same_agent(data: Transitions, kind: str) -> None:
    acted = []
    for seed in (3, 3, 4):
        agent = make(kind, seed=seed, meta_iterations=2 * (kind != "ampc"), adapt_batch_size=4)
        agent.meta_learn(data).learn(5)
        acted.append((theta_of(agent), agent.predict(data.obs[0, 0])[0]))
        agent.get_env().close()
    (theta, action), (same, same_action), (other, other_action) = acted
    assert torch.equal(theta, same)
    np.testing.assert_array_equal(action, same_action)
    assert not torch.equal(theta, other)
    assert not np.array_equal(action, other_action)


@every_kind
def test_members_of_an_ensemble_adapt_and_plan_together(data: Transitions, make_env: MakeEnv, kind: str) -> None:
    env = make_env(max_episode_steps=5)
    agent = make(kind, env, members=3, meta_iterations=2 * (kind != "ampc")).meta_learn(data)
    assert agent.model.members == 3
    assert len(theta_of(agent)) == 3
    state = run(agent, env, steps=6)
    assert state.belief.h.shape[:2] == (1, 3)
    agent.learn(4)
    assert len({tuple(row) for row in theta_of(agent).tolist()}) == 3
    loaded = KINDS[kind][0].load(saved(agent), env=env, device="cpu")
    np.testing.assert_array_equal(loaded.predict(data.obs[0, 0])[0], agent.predict(data.obs[0, 0])[0])


# --- what is refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["ampc", "maml"])
@pytest.mark.parametrize("robot", ["reacher", "minitaur"])
def test_agent_without_a_model_is_refused(kind: str, robot: str) -> None:
    """Also where the package ships a model: it is one of another kind of agent."""
    agent = KINDS[kind][0](robot, device="cpu")
    env, obs = agent.get_env(), np.zeros(agent.observation_space.shape)
    for call in (lambda: agent.predict(obs), agent.posterior, agent.marginals, lambda: agent.belief):
        with pytest.raises(NotLearnedError, match=r"meta_learn\(\) first, or load"):
            call()
    env.close()


@pytest.mark.parametrize(("right", "wrong"), [(AMPC, FAMLE), (AMPCMAML, AMPC), (AMPC, AMPCMAML), (FAMLE, AMPCMAML)])
def test_file_of_another_kind_of_agent_is_refused(make_env: MakeEnv, right: Any, wrong: Any) -> None:
    file, name = saved(right(make_env(), device="cpu")), right.__name__
    with pytest.raises(ValueError, match=rf"of {wrong.__name__} but of {name}; load it with {name}.load\(\)"):
        wrong.load(file, device="cpu")


# --- what they know ---------------------------------------------------------------------------------------


@every_kind
def test_the_one_embedding_stays_as_it_is(load: Load, data: Transitions, kind: str) -> None:
    agent = load(kind)
    embeddings = agent.model.embeddings
    assert embeddings.shape == (1, 1, 1)
    tell(agent, data, 4)
    assert torch.equal(agent.belief.h[0], embeddings[:, 0])


def test_rival_that_knows_nothing_is_a_random_network_in_the_units_of_the_simulation(
    data: Transitions, unseen: Transitions, make_env: MakeEnv
) -> None:
    one, other = (make("ampc", make_env(), members=2).meta_learn(given).model for given in (data, unseen))
    obs, next_obs = torch.from_numpy(data.obs), torch.from_numpy(data.next_obs)
    torch.testing.assert_close(one.input_mean, one.layout.features(obs).mean(dim=(0, 1)), rtol=1e-4, atol=1e-5)
    deviation = one.layout.change(obs, next_obs).flatten(0, 1).std(dim=0)
    torch.testing.assert_close(one.target_std, deviation, rtol=1e-4, atol=1e-5)
    assert not torch.equal(one.target_std, other.target_std)
    for name, value in one.theta.items():
        assert torch.equal(value, other.theta[name])  # whatever the transitions were
        assert (value == 0).all() == name.startswith("bias")


def encoded(agent: ModelBasedAgent, transitions: Transitions, rows: slice) -> Batch:
    """Some transitions of each situation as the agent's model sees them."""
    columns = (transitions.obs, transitions.action, transitions.next_obs)
    return agent.model.encode(*(torch.from_numpy(values[:, rows]) for values in columns))


@pytest.mark.parametrize("kind", ["reptile", "first-order-maml", "maml"])
def test_meta_learning_prepares_for_the_steps_on_the_robot(load: Load, unseen: Transitions, kind: str) -> None:
    losses, rule = [], load(kind).config.training.inner_loop
    for name in (kind, "ampc"):
        agent = load(name)
        model, support, query = agent.model, *(encoded(agent, unseen, half) for half in HALVES)
        theta, h = model.theta_of(11), model.embeddings_of(torch.arange(11))
        theta, h, _ = rule(model, theta, h, lambda data=support: data)
        losses.append(model.loss(query, h, theta).mean().item())
    assert losses[0] < 0.7 * losses[1]


def test_rival_learns_on_the_robots_from_scratch(load: Load, data: Transitions) -> None:
    agent, losses = load("ampc", adapt_steps=30, adapt_lr=0.003, memory_size=60), []
    later = encoded(agent, data, slice(45, 60))
    for i in range(45):
        agent.observe(data.obs[:, i], data.action[:, i], data.next_obs[:, i])
        losses.append(agent.model.loss(later, agent.belief.h, agent.belief.theta).mean().item())
    assert losses[-1] < 0.75 * losses[0]


# --- where the gradient steps begin -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "settings", "goes_on"),
    [
        ("ampc", {}, True),
        ("reptile", {"warm_start": False}, False),
        ("maml", {"warm_start": False}, False),
        ("maml", {"warm_start": True}, True),
    ],
)
def test_same_memory_teaches_more_only_where_steps_go_on(
    load: Load, data: Transitions, kind: str, settings: dict[str, Any], goes_on: bool
) -> None:
    agent = load(kind, **settings, memory_size=4, adapt_every=4)
    thetas = []
    for _ in range(3):
        tell(agent, data, 4)
        thetas.append(theta_of(agent))
    assert agent.belief.adaptations == 3
    assert torch.equal(thetas[0], thetas[1]) == torch.equal(thetas[1], thetas[2]) == (not goes_on)


# --- in simulation ----------------------------------------------------------------------------------------


def test_rounds_of_planning_in_simulation_need_no_embeddings(make_env: MakeEnv, tmp_path: Path) -> None:
    small = {"transitions_per_situation": 20, "rounds": 1, "round_transitions": 5, "meta_iterations": 2}
    agents = [make("reptile", make_env(), **small, joint_iterations=2, round_iterations=2) for _ in range(2)]
    for agent in agents:
        agent.meta_learn(["intact", "joint 0 reversed"], folder=tmp_path)
        assert agent.situations == ("intact", "joint 0 reversed")
    one, stored = (agent.model.state_dict() for agent in agents)
    assert all(torch.equal(value, stored[name]) for name, value in one.items())
