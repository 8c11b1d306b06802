from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks import curves, methods
from benchmarks.ant import ANT_METHODS
from benchmarks.methods import META_TRAINED, METHODS, ORIGINAL_CANDIDATES, PPO_METHODS, MetaTrained, about, from_cache
from benchmarks.reporting.registry import EXPERIMENTS, experiment_named
from benchmarks.task import Task
from famle_agent import AMPC, AMPCMAML, FAMLE, ModelBasedAgent, Transitions
from famle_agent.agents import meta_training
from famle_agent.agents.presets import known_robots
from famle_agent.training.progress import Progress
from famle_agent.training.trainer import MetaTrainer, Metrics
from tests.small_reacher import EPISODE, REDUCED, task_of

pytestmark = pytest.mark.usefixtures("small_reacher")

KINDS: dict[str, type[BaseAlgorithm]] = {
    **{name: FAMLE for name in METHODS if name.startswith("famle")},
    **{name: AMPCMAML for name in METHODS if name.startswith("ampc-")},
    **{
        "ampc": AMPC,
        "ampc-paper": AMPC,
        "ampc-original": AMPC,
        "ppo": PPO,
        "ppo-pretrained": PPO,
        "oracle": FAMLE,
        "one-simulator": FAMLE,
    },
}
IN_STEP = tuple(META_TRAINED)


def network_of(agent: Any) -> torch.Tensor:
    """All parameters of what the agent believes, one row a robot."""
    return torch.cat([value.flatten(1) for _, value in sorted(agent.belief.theta.items())], dim=1)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Which kinds of agent learn in simulation."""
    learnt: list[str] = []
    meta_learn = ModelBasedAgent.meta_learn

    def watch(self: ModelBasedAgent, *args: Any, **kwargs: Any) -> Any:
        learnt.append(type(self).__name__)
        return meta_learn(self, *args, **kwargs)

    monkeypatch.setattr(ModelBasedAgent, "meta_learn", watch)
    return learnt


# --- every method -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_every_method_makes_an_agent_that_lives_on_the_robot(method: str, cache: Path, watched: list[str]) -> None:
    task = task_of(1, cache)
    METHODS[method].learn(task)
    agent = METHODS[method].agent(task)
    learnt = len(watched)
    assert type(agent) is KINDS[method]
    assert isinstance(agent, PPO) == (method in PPO_METHODS)
    env = task.make()
    obs, _ = env.reset(seed=0)
    assert env.action_space.contains(agent.predict(obs)[0])
    env.close()
    (result,) = curves.run(agent, [task], 2 * EPISODE)
    assert result["situation"] == str(task.situation)
    assert result["lengths"][:2] == [EPISODE] * 2
    assert all(0 < value <= EPISODE for value in result["returns"])
    assert result["seconds_per_step"] > 0
    METHODS[method].learn(task)
    assert len(watched) == learnt  # nothing is learnt in simulation any more


@pytest.mark.parametrize(
    ("method", "expected"),
    [
        ("famle", {}),
        ("famle-frozen", {"adapt_every": 0}),
        ("famle-select", {"adapt_steps": 0}),
        ("famle-nearest", {"adapt_steps": 0, "compose": False}),
        ("famle-original", {"adapt_every": 0, "adapt_at_reset": True, "planning_reward": "squared_reward_fn"}),
        ("famle-paper", {"gate_actions": False, "planner": "random_shooting", "action_hold": 1}),
        ("famle-paper-held", {"gate_actions": False, "planner": "random_shooting", "action_hold": 5}),
        ("ampc", {"warm_start": True, "meta_iterations": 0}),
        ("ampc-reptile", {"meta_learner": "reptile", "warm_start": True}),
        (
            "ampc-reptile-paper",
            {"meta_learner": "reptile", "warm_start": False, "planner": "random_shooting", "embedding_dim": 1},
        ),
        ("ampc-fomaml", {"meta_learner": "first-order-maml", "inner_optimizer": "sgd"}),
        ("ampc-maml", {"meta_learner": "maml", "inner_optimizer": "sgd"}),
    ],
)
def test_methods_differ_by_their_settings(method: str, expected: dict[str, Any], cache: Path) -> None:
    agent = METHODS[method].agent(task_of(1, cache))
    assert isinstance(agent, ModelBasedAgent)
    settings = agent.config.to_dict()
    assert {name: settings[name] for name in expected} == expected
    assert settings["members"] == agent.model.members == 1
    agent.get_env().close()


def test_results_tell_settings_apart(cache: Path) -> None:
    one, same, other, rival, model_free = (
        about(METHODS[method].agent(task_of(seed, cache))).get("settings")
        for method, seed in (("famle", 0), ("famle", 1), ("famle-frozen", 0), ("ampc", 0), ("ppo", 0))
    )
    assert one == same
    assert len({one, other, rival, model_free}) == 4
    task = task_of(0, cache)
    (result,) = curves.run(METHODS["famle"].agent(task), [task], EPISODE)
    assert result["settings"] == one


def test_every_benchmark_knows_its_methods() -> None:
    assert {name for one in EXPERIMENTS for name in one.methods if one.robot != "ant"} <= set(METHODS)
    assert {name for one in EXPERIMENTS for name in one.methods} <= {*METHODS, *ANT_METHODS}
    assert {name for name, method in METHODS.items() if method.fleet is not None} == set(IN_STEP)


@pytest.mark.parametrize(
    ("changed", "again"),
    [({"memory_size": 3, "planner": "mppi"}, False), ({"hidden": [9]}, True), ({"inner_lr": 0.5}, True)],
)
@pytest.mark.parametrize("method", ["famle", "oracle", "one-simulator", "famle-paper", "ampc-maml"])
def test_cached_model_outlasts_all_settings_but_those_of_its_learning(
    method: str,
    changed: dict[str, Any],
    again: bool,
    tmp_path: Path,
    watched: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    METHODS[method].agent(task_of(0, tmp_path))
    watched.clear()
    robot = known_robots()["reacher"]
    tuned = [settings for rivals in robot.rivals.values() for settings in rivals.values()]
    for settings in (*robot.modes.values(), *tuned):
        for name, value in changed.items():
            monkeypatch.setitem(settings, name, value)
    agent: Any = METHODS[method].agent(task_of(0, tmp_path))
    assert bool(watched) == again
    assert agent.config.to_dict().items() >= changed.items()
    METHODS[method].agent(task_of(0, tmp_path))
    assert len(watched) == again


def test_model_that_is_not_shipped_is_named() -> None:
    with pytest.raises(RuntimeError, match="famle meta-learn --robot reacher"):
        methods.shipped(task_of(0, Path("unused")))


# --- networks side by side --------------------------------------------------------------------------------


@pytest.mark.parametrize(("cls", "own"), [(AMPC, {}), (AMPCMAML, {"meta_learner": "maml"}), (FAMLE, {})])
def test_replicates_take_turns_with_the_networks_of_one_ensemble(
    cls: type[ModelBasedAgent], own: dict[str, Any], tmp_path: Path, watched: list[str]
) -> None:
    recipe = MetaTrained("name", cls, networks=3, settings=own)
    agents: list[Any] = [recipe.agent(task_of(seed, tmp_path)) for seed in (0, 1, 2, 4)]
    assert watched == [cls.__name__]
    ensemble: Any = recipe.learn(task_of(0, tmp_path))
    assert ensemble.dynamics.members == 3
    for agent, seed in zip(agents, (0, 1, 2, 4), strict=True):
        assert agent.dynamics.members == agent.config.model.members == 1
        assert agent.seed == seed
        assert agent.situations == ensemble.situations
        for name, value in ensemble.dynamics.theta.items():
            assert torch.equal(agent.dynamics.theta[name][0], value[seed % 3])
    assert len({tuple(network_of(agent)[0].tolist()) for agent in agents}) == 3
    for agent in (*agents, ensemble):
        agent.get_env().close()


@pytest.mark.parametrize("method", IN_STEP)
def test_replicates_of_a_method_have_networks_of_their_own(method: str, cache: Path) -> None:
    networks = META_TRAINED[method].networks
    agents = [METHODS[method].agent(task_of(seed, cache)) for seed in range(networks + 1)]
    assert len({tuple(network_of(agent)[0].tolist()) for agent in agents}) == networks  # and then they take turns


def test_rivals_learn_from_the_same_transitions(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    given: list[Any] = []
    meta_learn = ModelBasedAgent.meta_learn

    def watch(self: ModelBasedAgent, envs: Any, **kwargs: Any) -> Any:
        given.append(envs)
        return meta_learn(self, envs, **kwargs)

    monkeypatch.setattr(ModelBasedAgent, "meta_learn", watch)
    for recipe in (MetaTrained("one", AMPC), MetaTrained("other", AMPCMAML), MetaTrained("paper", FAMLE, "paper")):
        recipe.learn(task_of(0, tmp_path))
    assert given[0].digest() == given[1].digest()
    assert given[0].obs.shape == (11, REDUCED["transitions_per_situation"], 12)
    assert given[2] is None  # the paper's collects its own, without holding actions


def test_stopped_meta_training_goes_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(meta_training, "Progress", partial(Progress, every=0.0))
    recipe, task = MetaTrained("paper", FAMLE, "paper"), task_of(0, tmp_path / "stopped")
    whole = recipe.learn(task_of(0, tmp_path / "whole"))
    fit, iterations = MetaTrainer.fit, list[int]()

    def stops(self: MetaTrainer, *args: Any) -> Iterator[Metrics]:
        for metrics in fit(self, *args):
            iterations.append(1)
            yield metrics
            if len(iterations) == 2:
                raise KeyboardInterrupt

    monkeypatch.setattr(MetaTrainer, "fit", stops)
    with pytest.raises(KeyboardInterrupt):
        recipe.learn(task)
    assert torch.equal(network_of(recipe.learn(task)), network_of(whole))
    assert len(iterations) == 3  # the first is not done again
    assert {path.name for path in task.cache.iterdir()} == {"reacher-paper.zip", "reacher-paper.zip.lock"}


def test_of_replicates_at_the_same_time_one_learns(tmp_path: Path) -> None:
    learnt: list[Any] = []

    class Replicate:
        dynamics: str | None = None

        def take_model(self, path: Path) -> None:
            self.dynamics = path.read_text()

        def save(self, path: Path) -> None:
            path.write_text("what was learnt")

    def learn(agent: Any) -> None:
        learnt.append(agent)
        time.sleep(0.2)

    def run(agent: Any) -> Any:
        return from_cache(agent, tmp_path / "cache" / "one.zip", learn)

    with ThreadPoolExecutor(3) as pool:
        agents = list(pool.map(run, [Replicate() for _ in range(3)]))
    assert [agent.dynamics for agent in agents if agent is not learnt[0]] == ["what was learnt"] * 2
    assert len(learnt) == 1


def test_replicates_share_one_network_where_one_is_shipped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Task, "is_shipped", True)
    recipe = MetaTrained("alone", AMPC)
    one, other = (recipe.agent(task_of(seed, tmp_path)) for seed in (0, 1))
    assert one.model.members == 1
    assert torch.equal(network_of(one), network_of(other))


@pytest.mark.parametrize("method", IN_STEP)
def test_robots_in_step_have_the_networks_of_their_replicates(method: str, cache: Path) -> None:
    tasks = [task_of(seed, cache) for seed in (2, 0)]
    fleet: Any = METHODS[method].fleet(tasks)  # type: ignore[misc]
    expected = torch.cat([network_of(METHODS[method].agent(task)) for task in tasks])
    assert torch.equal(network_of(fleet), expected)
    fleet.set_env(DummyVecEnv([task.make for task in tasks]))
    fleet.learn(2)
    assert torch.equal(network_of(fleet), expected)  # one step a robot: too early to adapt
    fleet.learn(2 * max(1, fleet.config.adaptation.every - 1))
    assert fleet.belief.adaptations == 1
    moved = (network_of(fleet) - expected).abs().amax(dim=1)
    assert (moved > 0).all()
    assert moved.max() < 0.5  # each is near its own
    fleet.get_env().close()


def test_results_say_how_adaptations_went(cache: Path) -> None:
    tasks = [task_of(seed, cache) for seed in (0, 1)]
    fleet = METHODS["ampc-reptile-paper"].on(tasks)
    assert isinstance(fleet, ModelBasedAgent)
    results = curves.run(fleet, tasks, 4 * EPISODE)
    assert [(result["adaptations"], result["diverged"]) for result in results] == [(4, 0)] * 2
    assert all(result["device"] == "cpu" for result in results)
    (model_free,) = curves.run(METHODS["ppo"].agent(tasks[0]), tasks[:1], EPISODE)
    assert "diverged" not in model_free


def test_network_may_be_learnt_with_another_planner_than_it_is_used_with(tmp_path: Path) -> None:
    recipe = MetaTrained("planned", FAMLE, "paper", simulation={"candidates": 3})
    assert recipe.learn(task_of(0, tmp_path)).config.planner.candidates == 3
    assert recipe.agent(task_of(0, tmp_path)).config.planner.candidates == REDUCED["candidates"]


def test_title_says_what_the_planned_data_of_the_authors_settings_were_planned_with() -> None:
    assert f"planned data with {ORIGINAL_CANDIDATES} sequences" in experiment_named("ant-curves").title


def test_simulated_data_of_other_settings_are_refused(tmp_path: Path) -> None:
    task = task_of(0, tmp_path)
    data = methods.simulated_data(task)
    assert methods.simulated_data(task).digest() == data.digest()
    fewer = {name: getattr(data, name)[:, 1:] for name in ("obs", "action", "reward", "next_obs")}
    Transitions(**fewer, situations=data.situations).save(tmp_path / "reacher-transitions.npz")
    with pytest.raises(ValueError, match="holds other transitions"):
        methods.simulated_data(task)
