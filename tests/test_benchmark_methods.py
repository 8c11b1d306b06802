from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch
from joblib import parallel_config
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks import curves, lives, methods, reacher
from benchmarks.compare import compare
from benchmarks.harness import Options, ReplicateError, Result, load_results
from benchmarks.methods import METHODS, PPO_METHODS, MetaTrained, Method, Task
from famle_agent import AMPC, AMPCMAML, FAMLE, ModelBasedAgent
from famle_agent.robots import known_robots
from famle_envs import Situation
from famle_envs.reacher import ReacherEnv

EPISODE = 6
REDUCED: dict[str, Any] = {
    "transitions_per_situation": 12,
    "hidden": [8],
    "meta_iterations": 2,
    "inner_steps": 2,
    "batch_size": 4,
    "query_size": 4,
    "adapt_steps": 2,
    "memory_size": 20,
    "planner": "random_shooting",
    "horizon": 2,
    "candidates": 6,
}
KINDS: dict[str, type[BaseAlgorithm]] = {
    **{name: FAMLE for name in METHODS if name.startswith("famle")},
    **{name: AMPCMAML for name in METHODS if name.startswith("ampc-")},
    **{"ampc": AMPC, "ppo": PPO, "ppo-pretrained": PPO, "oracle": FAMLE, "one-simulator": FAMLE},
}
IN_STEP = ("ampc", "ampc-reptile", "ampc-fomaml", "ampc-maml")


@pytest.fixture(autouse=True)
def reduced(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Shrinks what an agent for the reacher spends, and the reacher's episodes; all in this process."""
    robot = known_robots()["reacher"]
    for settings in (*robot.modes.values(), *robot.rivals.values()):
        for name, value in REDUCED.items():
            monkeypatch.setitem(settings, name, value)
    monkeypatch.setitem(robot.modes["original"], "adapt_epochs", 1)
    monkeypatch.setattr(methods, "PPO", lambda *args, **kwargs: PPO(*args, **{**kwargs, "n_steps": 8, "batch_size": 8}))
    monkeypatch.setitem(methods.PPO_SIMULATED, "reacher", 16)  # type: ignore[arg-type]
    monkeypatch.setattr(gym.spec("FamleReacher-v0"), "max_episode_steps", EPISODE)
    with parallel_config("sequential"):
        yield


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the tests share what is learnt in simulation."""
    return tmp_path_factory.mktemp("cache")


def task_of(seed: int, cache: Path, situation: Situation = ReacherEnv.presets["paper"]) -> Task:
    return Task("reacher", seed, situation, cache)


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
        ("famle-likeliest", {"spread_members": False}),
        ("famle-nearest", {"adapt_steps": 0, "compose": False, "spread_members": False}),
        ("famle-original", {"adapt_every": 0, "adapt_at_reset": True, "planning_reward": "squared_reward_fn"}),
        ("famle-paper", {"gate_actions": False, "planner": "random_shooting"}),
        ("ampc", {"keep_adapting": True, "meta_iterations": 0}),
        ("ampc-reptile", {"meta_learner": "reptile", "keep_adapting": True}),
        ("ampc-fomaml", {"meta_learner": "first-order-maml", "inner_optimizer": "sgd"}),
        ("ampc-maml", {"meta_learner": "maml", "inner_optimizer": "sgd"}),
    ],
)
def test_methods_differ_by_their_settings(method: str, expected: dict[str, Any], cache: Path) -> None:
    agent = METHODS[method].agent(task_of(1, cache))
    assert isinstance(agent, ModelBasedAgent)
    settings = agent.hyperparameters
    assert {name: getattr(settings, name) for name in expected} == expected
    assert settings.members == agent._require_dynamics().members == 1
    agent.get_env().close()


def test_every_benchmark_knows_its_methods() -> None:
    assert {*reacher.MODEL_BASED, *PPO_METHODS, "famle-frozen", "oracle"} <= set(METHODS)
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
    for settings in (*robot.modes.values(), *robot.rivals.values()):
        for name, value in changed.items():
            monkeypatch.setitem(settings, name, value)
    agent: Any = METHODS[method].agent(task_of(0, tmp_path))
    assert bool(watched) == again
    assert agent.hyperparameters.to_dict().items() >= changed.items()
    METHODS[method].agent(task_of(0, tmp_path))
    assert len(watched) == again


def test_model_that_is_not_shipped_is_named() -> None:
    with pytest.raises(RuntimeError, match="famle meta-learn --robot reacher"):
        methods.shipped("reacher", seed=0)


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
        assert agent.dynamics.members == agent.hyperparameters.members == 1
        assert agent.seed == seed
        assert agent.situations == ensemble.situations
        for name, value in ensemble.dynamics.theta.items():
            assert torch.equal(agent.dynamics.theta[name][0], value[seed % 3])
    assert len({tuple(network_of(agent)[0].tolist()) for agent in agents}) == 3
    for agent in (*agents, ensemble):
        agent.get_env().close()


@pytest.mark.parametrize("method", [*IN_STEP, "famle-paper", "famle-original"])
def test_replicates_of_a_method_have_networks_of_their_own(method: str, cache: Path) -> None:
    agents = [METHODS[method].agent(task_of(seed, cache)) for seed in range(10)]
    assert len({tuple(network_of(agent)[0].tolist()) for agent in agents}) == 10


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


def test_replicates_share_one_network_where_one_is_shipped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(methods, "_is_shipped", lambda robot: True)
    recipe = MetaTrained("alone", AMPC)
    one, other = (recipe.agent(task_of(seed, tmp_path)) for seed in (0, 1))
    assert one._require_dynamics().members == 1
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
    fleet.learn(4)
    assert fleet.belief.adaptations == 1
    moved = (network_of(fleet) - expected).abs().amax(dim=1)
    assert (moved > 0).all()
    assert moved.max() < 0.1  # each goes on from its own
    fleet.get_env().close()


def test_robots_that_would_go_back_to_another_network_are_refused(tmp_path: Path) -> None:
    recipe = MetaTrained("restarts", AMPCMAML, settings={"keep_adapting": False})
    with pytest.raises(ValueError, match="run them one by one"):
        recipe.fleet([task_of(0, tmp_path)])


# --- learning curves --------------------------------------------------------------------------------------


@pytest.fixture
def code(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Says which commit the code is of."""
    return lambda name: monkeypatch.setattr(lives, "commit", lambda: name)


def test_same_task_same_curve(cache: Path) -> None:
    runs = [curves.run(METHODS["ampc"].agent(task_of(seed, cache)), [task_of(seed, cache)], 15) for seed in (0, 0, 1)]
    (one,), (same,), (other,) = ([result["returns"] for result in run] for run in runs)
    assert one == same != other
    assert len(one) == 2  # the third episode has not ended


def test_curve_needs_an_episode(cache: Path) -> None:
    task = task_of(0, cache)
    with pytest.raises(ValueError, match=f"{EPISODE - 1} robot steps are no whole episode.*needs {EPISODE} at least"):
        curves.run(METHODS["famle"].agent(task), [task], EPISODE - 1)
    (result,) = curves.run(METHODS["famle"].agent(task), [task], EPISODE)
    assert len(result["returns"]) == 1


def test_robots_in_step_have_damages_and_curves_of_their_own(cache: Path) -> None:
    broken = [ReacherEnv.presets["joint 3 dead"], ReacherEnv.presets["joint 0 reversed"]]
    tasks = [task_of(seed, cache, situation) for seed, situation in enumerate(broken)]
    results = reacher.run_fleet("ampc", tasks, reacher.Args(steps=2 * EPISODE))
    assert [result["situation"] for result in results] == ["joint 3 dead", "joint 0 reversed"]
    assert all(result["lengths"] == [EPISODE] * 2 for result in results)
    assert results[0]["returns"] != results[1]["returns"]
    with pytest.raises(ValueError, match="run one by one, not 2 in step"):
        reacher.run_fleet("famle", tasks, reacher.Args(steps=2))


@pytest.mark.parametrize(
    ("method", "robots"), [("famle", 1), ("famle-original", 1), ("famle-paper", 1), ("ampc", 2), ("ampc-reptile", 2)]
)
def test_interrupted_life_ends_as_if_nothing_had_happened(
    method: str, robots: int, cache: Path, tmp_path: Path, code: Callable[[str], None]
) -> None:
    code("1a2b3c4")
    tasks, life = [task_of(seed, cache) for seed in range(robots)], tmp_path / "life.zip"

    def returns(episodes: int, saved: Path | None) -> list[list[float]]:
        results = curves.run(METHODS[method].on(tasks), tasks, episodes * EPISODE, saved, save_every=0.0)
        assert all(result["lengths"] == [EPISODE] * episodes for result in results)
        return [result["returns"] for result in results]

    whole = returns(5, None)
    assert returns(2, life) == [robot[:2] for robot in whole]
    assert returns(5, life) == whole
    assert returns(4, life) == [robot[:4] for robot in whole]


def test_long_life_is_not_lived_again(cache: Path, tmp_path: Path, code: Callable[[str], None]) -> None:
    code("1a2b3c4")
    task, life = task_of(0, cache), tmp_path / "life.zip"
    (long,) = curves.run(METHODS["famle"].agent(task), [task], 2 * EPISODE, life, save_every=0.0)
    (short,) = curves.run(METHODS["famle"].agent(task), [task], EPISODE, life, save_every=0.0)
    assert short["returns"] == long["returns"][:1]
    assert short["seconds_per_step"] == pytest.approx(long["seconds_per_step"], rel=0.2)


@pytest.mark.parametrize(
    ("before", "after"), [("1a2b3c4", "5d6e7f8"), ("1a-dirty", "1a-dirty"), ("unknown", "unknown")]
)
def test_life_of_other_code_begins_anew(
    before: str, after: str, cache: Path, tmp_path: Path, code: Callable[[str], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    task, life = task_of(0, cache), tmp_path / "life.zip"
    code(before)
    curves.run(METHODS["famle"].agent(task), [task], EPISODE, life, save_every=0.0)
    assert life.exists()
    code(after)
    lived: list[int] = []
    learn = ModelBasedAgent.learn
    monkeypatch.setattr(
        ModelBasedAgent, "learn", lambda self, steps, **more: (lived.append(steps), learn(self, steps, **more))[1]
    )
    curves.run(METHODS["famle"].agent(task), [task], 2 * EPISODE, life)
    assert lived == [2 * EPISODE]


def test_ppo_is_not_saved_on_its_way(cache: Path, tmp_path: Path) -> None:
    task, life = task_of(0, cache), tmp_path / "life.zip"
    curves.run(METHODS["ppo"].agent(task), [task], 2 * EPISODE, life, save_every=0.0)
    assert not life.exists()


def test_life_is_saved_now_and_then(cache: Path, tmp_path: Path) -> None:
    task, life = task_of(0, cache), tmp_path / "life.zip"
    curves.run(METHODS["famle"].agent(task), [task], 2 * EPISODE, life)
    assert not life.exists()  # not a minute has passed


def test_test_robot_is_broken_as_the_task_says(cache: Path) -> None:
    task = task_of(0, cache)
    env = task.make()
    assert env.get_wrapper_attr("situation") == task.situation
    assert task.env_id == env.spec.id
    env.close()


# --- methods on test robots -------------------------------------------------------------------------------


@pytest.fixture
def calls() -> list[str]:
    """What was done, in order."""
    return []


@pytest.fixture
def play(calls: list[str], tmp_path: Path) -> Callable[..., Path]:
    """Compares methods that only say what they do; "fleet" has robots that act in step."""

    def none(task: Task) -> Any:
        raise NotImplementedError

    def learning(name: str) -> Callable[[Task], object]:
        return lambda task: calls.append(f"{name} learns")

    known = {name: Method(none, learning(name)) for name in ("one", "other")}
    known["fleet"] = replace(known["one"], learn=learning("fleet"), fleet=none)

    def run(method: str, task: Task) -> Result:
        calls.append(f"{method} {task.seed}")
        if (method, task.seed) == ("one", 13):
            raise ArithmeticError("a replicate fails")
        return {"value": task.seed}

    def run_fleet(method: str, tasks: Sequence[Task]) -> list[Result]:
        calls.append(f"{method} {[task.seed for task in tasks]}")
        return [{"value": task.seed} for task in tasks]

    def compared(names: Sequence[str], seeds: Sequence[int], in_step: int = 30) -> Path:
        tasks = [task_of(seed, tmp_path) for seed in seeds]
        folder = tmp_path / "results"
        options = Options(jobs=1, in_step=in_step)
        compare(names, tasks, run, folder, options, known, run_fleet if in_step else None)
        return folder

    return compared


def test_method_learns_once_before_its_replicates(play: Callable[..., Path], calls: list[str]) -> None:
    folder = play(["one", "other"], [0, 1])
    assert calls == ["one learns", "one 0", "one 1", "other learns", "other 0", "other 1"]
    assert [(result["method"], result["value"]) for result in load_results(folder)] == [
        *(("one", 0), ("one", 1)),
        *(("other", 0), ("other", 1)),
    ]


def test_what_is_stored_is_neither_learnt_nor_run_again(play: Callable[..., Path], calls: list[str]) -> None:
    play(["one", "fleet"], [0, 1])
    calls.clear()
    play(["one", "fleet"], [1, 0])
    assert calls == []
    play(["one", "fleet"], [0, 2])
    assert calls == ["one learns", "one 2", "fleet learns", "fleet [0, 2]"]


def test_robots_act_in_step_where_method_and_benchmark_can(play: Callable[..., Path], calls: list[str]) -> None:
    folder = play(["fleet"], [0, 1])
    assert calls == ["fleet learns", "fleet [0, 1]"]
    assert [(result["seed"], result["value"], result["fleet"]) for result in load_results(folder)] == [
        *((0, 0, 2), (1, 1, 2)),
    ]
    calls.clear()
    play(["fleet"], [2, 3], in_step=0)
    assert calls == ["fleet learns", "fleet 2", "fleet 3"]
    calls.clear()
    play(["fleet"], [4, 5, 6], in_step=2)
    assert calls == ["fleet learns", "fleet [4, 5]", "fleet [6]"]


def test_unknown_method_is_refused_before_anything_runs(play: Callable[..., Path], calls: list[str]) -> None:
    with pytest.raises(ValueError, match=r"no method 'magic'\. Methods: one, other, fleet"):
        play(["one", "magic"], [0])
    assert calls == []


def test_failing_replicate_does_not_end_the_others(play: Callable[..., Path], calls: list[str], tmp_path: Path) -> None:
    with pytest.raises(ReplicateError):
        play(["one"], [0, 13, 1])
    assert calls == ["one learns", "one 0", "one 13", "one 1"]
    assert [result["seed"] for result in load_results(tmp_path / "results")] == [0, 1]


def test_failing_replicate_does_not_end_the_other_methods(play: Callable[..., Path], calls: list[str]) -> None:
    with pytest.raises(ReplicateError):
        play(["one", "other"], [13])
    assert "other 13" in calls
