from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from famle_agent import FAMLE, Transitions
from famle_agent.agents import meta_training
from famle_agent.models.dynamics import Dynamics
from famle_agent.training.progress import Progress

SITUATIONS = ["intact", "joint 0 reversed", "joint 3 dead"]
TINY: dict[str, Any] = {
    "transitions_per_situation": 40,
    "rounds": 2,
    "round_transitions": 12,
    "hidden": (16,),
    "members": 2,
    "joint_iterations": 6,
    "round_iterations": 4,
    "joint_batch_size": 32,
    "meta_iterations": 3,
    "meta_batch_size": 3,
    "horizon": 3,
    "candidates": 8,
    "planner_iterations": 2,
    "elites": 3,
}
NO_META: dict[str, Any] = {"meta_iterations": 0, "meta_batch_size": 0}
ONE_ROUND: dict[str, Any] = {"rounds": 0, "round_transitions": 0, "round_iterations": 0}
ITERATIONS = [6, 10, 17]
"""Iterations that are done after each round; Algorithm 1 comes after the last one."""


@pytest.fixture
def make_agent() -> Iterator[Callable[..., FAMLE]]:
    agents: list[FAMLE] = []

    def make(**overrides: Any) -> FAMLE:
        agents.append(FAMLE("reacher", device="cpu", **{"seed": 0, **TINY, **overrides}))
        return agents[-1]

    yield make
    for agent in agents:
        agent.get_env().close()


Make = Callable[..., FAMLE]


@pytest.fixture(scope="module")
def uninterrupted() -> Dynamics:
    """What all rounds give."""
    agent = FAMLE("reacher", device="cpu", seed=0, **TINY).meta_learn(SITUATIONS)
    agent.get_env().close()
    assert agent.dynamics is not None
    return agent.dynamics


def assert_same(one: Dynamics | None, other: Dynamics) -> None:
    assert one is not None
    for name, value in one.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name


def stored(folder: Path, round_: int) -> list[Transitions]:
    return [Transitions.load(file) for file in sorted((folder / f"round-{round_}").iterdir())]


def watch(agent: FAMLE, monkeypatch: pytest.MonkeyPatch) -> list[Transitions]:
    """All transitions that each round learns from."""
    seen: list[Transitions] = []
    begin = meta_training.begin_model

    def begin_model(policy: Any, transitions: Transitions, *args: Any) -> Any:
        if policy is agent.policy:
            seen.append(transitions)
        return begin(policy, transitions, *args)

    monkeypatch.setattr(meta_training, "begin_model", begin_model)
    return seen


def models_of_rounds(monkeypatch: pytest.MonkeyPatch) -> list[Dynamics]:
    """The model that each round learns."""
    models, begin = list[Dynamics](), meta_training.begin_model

    def begin_model(*args: Any) -> Any:
        model, data = begin(*args)
        models.append(model)
        return model, data

    monkeypatch.setattr(meta_training, "begin_model", begin_model)
    return models


def interrupt_at(iteration: int) -> Callable[..., bool]:
    def callback(local: dict[str, Any], _: Any) -> bool:
        if local["self"].num_iterations == iteration:
            raise KeyboardInterrupt
        return True

    return callback


# --- rounds -------------------------------------------------------------------------------------------------


def test_each_round_learns_from_more_transitions(make_agent: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    agent, steps = make_agent(), list[int]()
    seen = watch(agent, monkeypatch)
    agent.meta_learn(SITUATIONS, callback=lambda local, _: steps.append(local["self"].num_iterations) or True)
    assert [transitions.obs.shape[1] for transitions in seen] == [40, 52, 64]
    for earlier, later in pairwise(seen):
        n = earlier.obs.shape[1]
        np.testing.assert_array_equal(later.obs[:, :n], earlier.obs)
        np.testing.assert_array_equal(later.action[:, :n], earlier.action)
    assert steps == list(range(1, ITERATIONS[-1] + 1))
    assert agent.num_timesteps == 0
    assert agent.situations == tuple(SITUATIONS)


def test_rounds_plan_for_the_reward(make_agent: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the agent does in its rounds is better than chance, and no longer held for some steps."""
    agent = make_agent(
        rounds=1, round_transitions=50, joint_iterations=400, joint_lr=0.01, candidates=40, horizon=6, hidden=(70, 50)
    )
    seen = watch(agent, monkeypatch)
    agent.meta_learn(SITUATIONS)
    first, last = seen[-1].reward[:, :40], seen[-1].reward[:, 60:]  # once it has come to the goal
    assert last.mean() > first.mean() + 0.1
    held = agent.config.simulation.action_hold
    assert held > 1
    np.testing.assert_array_equal(seen[-1].action[:, 0], seen[-1].action[:, 1])
    changed = np.abs(np.diff(seen[-1].action[:, 40:], axis=1)).max(axis=-1) > 1e-3
    assert changed.mean() > 0.9


def test_model_goes_on_from_round_to_round(make_agent: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_agent(joint_lr=0.0, joint_embedding_lr=0.0, **NO_META)
    models = models_of_rounds(monkeypatch)
    agent.meta_learn(SITUATIONS)
    assert models[0] is models[1] is models[2]
    fresh = make_agent(joint_lr=0.0, joint_embedding_lr=0.0, **NO_META, **ONE_ROUND).meta_learn(SITUATIONS)
    assert fresh.dynamics is not None
    assert torch.equal(models[2].embeddings, fresh.dynamics.embeddings)
    assert torch.equal(models[2].input_mean, fresh.dynamics.input_mean)  # the units stay those of the first round


def test_last_round_may_begin_anew(make_agent: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    agent = make_agent(restart_last_round=True, joint_lr=0.0, joint_embedding_lr=0.0, **NO_META)
    models = models_of_rounds(monkeypatch)
    agent.meta_learn(SITUATIONS)
    assert models[0] is models[1] is not models[2]
    assert not torch.equal(models[2].embeddings, models[0].embeddings)
    assert not torch.equal(models[2].input_mean, models[0].input_mean)  # it is measured on all transitions


def test_meta_learning_again_begins_anew(make_agent: Make) -> None:
    agent = make_agent(**ONE_ROUND).meta_learn(SITUATIONS)
    before = agent.dynamics
    agent.meta_learn(SITUATIONS)
    assert agent.dynamics is not before


def test_given_transitions_are_all_that_is_learnt_from(
    make_agent: Make, transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent, steps = make_agent(), list[int]()
    seen = watch(agent, monkeypatch)
    agent.meta_learn(transitions, callback=lambda *_: steps.append(1) or True)
    assert [data.obs.shape for data in seen] == [transitions.obs.shape]
    assert len(steps) == TINY["joint_iterations"] + TINY["meta_iterations"]


@pytest.mark.parametrize("last", [3, 8, 15])
def test_callback_ends_all_rounds(make_agent: Make, last: int, tmp_path: Path) -> None:
    agent, steps = make_agent(), list[int]()
    agent.meta_learn(
        SITUATIONS,
        callback=lambda local, _: steps.append(1) or local["self"].num_iterations < last,
        folder=tmp_path,
    )
    assert len(steps) == last
    done = sum(last > iterations for iterations in ITERATIONS)
    assert sorted(tmp_path.glob("*.zip")) == [tmp_path / f"round-{i}.zip" for i in range(done)]
    agent.predict(np.zeros(12, np.float32))  # the agent has a model all the same


def test_reward_that_is_learned_judges_the_plans_of_a_round() -> None:
    """The reward network knows actions in [-1, 1]; the environment's go from -2 to 2."""
    settings = (
        TINY
        | ONE_ROUND
        | {"policy_steps": 0, "candidates": 40, "planner": "random_shooting", "planner_iterations": 0, "elites": 0}
    )
    agent = FAMLE("Pendulum-v1", device="cpu", seed=0, **settings)
    agent.meta_learn([lambda g=g: gym.make("Pendulum-v1", g=g) for g in (3.0, 10.0)])
    policy = agent.planning_policy()(agent.get_env().envs, [0], np.random.default_rng(0))
    seen: list[torch.Tensor] = []
    original = type(agent.policy.world.reward).forward

    def forward(self: Any, obs: torch.Tensor, action: torch.Tensor, next_obs: torch.Tensor) -> torch.Tensor:
        seen.append(action)
        return original(self, obs, action, next_obs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(agent.policy.world.reward), "forward", forward)
        (action,) = policy(np.array([[1.0, 0.0, 0.0]], np.float32), np.array([True]))
    assert seen
    assert 0.9 < torch.cat([value.flatten() for value in seen]).abs().max() <= 1.0 + 1e-6
    assert agent.action_space.contains(action)


# --- a run that is stopped ----------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [0.0, 60.0], ids=["saved each iteration", "saved after each stage"])
@pytest.mark.parametrize("iteration", [2, 8, 12, 16], ids=["round 0", "round 1", "round 2", "Algorithm 1"])
def test_interrupted_run_goes_on_to_the_same_agent(
    make_agent: Make,
    uninterrupted: Dynamics,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    iteration: int,
    every: float,
) -> None:
    monkeypatch.setattr(meta_training, "Progress", partial(Progress, every=every))
    with pytest.raises(KeyboardInterrupt):
        make_agent().meta_learn(SITUATIONS, callback=interrupt_at(iteration), folder=tmp_path)
    rounds = sum(iteration > done for done in ITERATIONS)
    assert sorted(tmp_path.glob("*.zip")) == [tmp_path / f"round-{i}.zip" for i in range(rounds)]
    files = {file: file.read_bytes() for file in [*tmp_path.rglob("*.zip"), *tmp_path.rglob("*.npz")]}
    steps: list[int] = []
    agent = make_agent()
    agent.meta_learn(
        SITUATIONS, callback=lambda local, _: steps.append(local["self"].num_iterations) or True, folder=tmp_path
    )
    assert_same(agent.dynamics, uninterrupted)
    saved = iteration - 1 if every == 0.0 else {2: 0, 8: 6, 12: 10, 16: 14}[iteration]
    assert steps == list(range(saved + 1, ITERATIONS[-1] + 1))
    assert not list(tmp_path.glob("*.progress"))  # of no use to a round that is done
    assert all(file.read_bytes() == content for file, content in files.items())  # nothing is done twice
    assert [data.obs.shape[1] for data in stored(tmp_path, 2)] == [12] * 3


def test_interrupted_simulation_goes_on_to_the_same_agent(
    make_agent: Make, uninterrupted: Dynamics, tmp_path: Path
) -> None:
    """Stopped in the first round of planning, when one of its situations was stored."""
    save = Transitions.save

    def stops(transitions: Transitions, path: Path) -> None:
        if path.parent.name == "round-1" and path.name != "situation-000.npz":
            raise KeyboardInterrupt
        save(transitions, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Transitions, "save", stops)
        with pytest.raises(KeyboardInterrupt):
            make_agent().meta_learn(SITUATIONS, folder=tmp_path)
    (first,) = (tmp_path / "round-1").iterdir()
    stored_then = first.read_bytes()
    assert_same(make_agent().meta_learn(SITUATIONS, folder=tmp_path).dynamics, uninterrupted)
    assert first.name == "situation-000.npz"
    assert first.read_bytes() == stored_then


def test_run_that_is_done_is_only_read(make_agent: Make, uninterrupted: Dynamics, tmp_path: Path) -> None:
    assert_same(make_agent().meta_learn(SITUATIONS, folder=tmp_path).dynamics, uninterrupted)
    steps: list[int] = []
    again = make_agent().meta_learn(SITUATIONS, callback=lambda *_: steps.append(1) or True, folder=tmp_path)
    assert steps == []
    assert_same(again.dynamics, uninterrupted)
    assert again.situations == tuple(SITUATIONS)


@pytest.mark.slow
def test_processes_give_the_same_agent(make_agent: Make, uninterrupted: Dynamics, tmp_path: Path) -> None:
    assert_same(make_agent().meta_learn(SITUATIONS, n_jobs=2, folder=tmp_path).dynamics, uninterrupted)


@pytest.mark.parametrize("iteration", [2, 8], ids=["in the first round", "in the second"])
def test_interrupted_rounds_leave_the_agent_as_it_was(make_agent: Make, iteration: int) -> None:
    agent = make_agent().meta_learn(SITUATIONS)
    known, weights = agent.dynamics, copy.deepcopy(agent.dynamics.state_dict())

    def stop(local: dict[str, Any], _: dict[str, Any]) -> bool:
        if agent.num_iterations == iteration:
            raise KeyboardInterrupt
        return True

    with pytest.raises(KeyboardInterrupt):
        agent.meta_learn(SITUATIONS[:2], callback=stop)
    assert agent.dynamics is known
    assert all(torch.equal(value, weights[name]) for name, value in agent.dynamics.state_dict().items())
    assert agent.situations == tuple(SITUATIONS)
    assert agent.num_timesteps == 0


# --- a folder that does not fit ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of one round."""
    folder = tmp_path_factory.mktemp("run")
    agent = FAMLE("reacher", device="cpu", seed=0, **(TINY | ONE_ROUND)).meta_learn(SITUATIONS, folder=folder)
    agent.get_env().close()
    return folder


@pytest.mark.parametrize(
    ("overrides", "situations", "differing"),
    [
        ({"horizon": 4}, SITUATIONS, "hyperparameters"),
        ({"seed": 1}, SITUATIONS, "seed"),
        ({}, SITUATIONS[:2], "sources, situations"),
        ({"seed": 1}, SITUATIONS[::-1], "seed, sources, situations"),
        ({"angle_dims": (0,)}, SITUATIONS, "dimensions"),
        ({"reward_fn": lambda obs, action, next_obs: next_obs[..., 0]}, SITUATIONS, "reward_fn"),
    ],
)
def test_folder_of_another_run_is_refused(
    make_agent: Make, finished: Path, overrides: dict[str, Any], situations: list[str], differing: str
) -> None:
    with pytest.raises(ValueError, match=rf"differs in: {differing}\."):
        make_agent(**ONE_ROUND, **overrides).meta_learn(situations, folder=finished)


@pytest.mark.parametrize("size", [0, 100])
def test_damaged_model_of_a_round_is_named(make_agent: Make, finished: Path, tmp_path: Path, size: int) -> None:
    for file in (path for path in finished.rglob("*") if path.is_file()):
        copy = tmp_path / file.relative_to(finished)
        copy.parent.mkdir(exist_ok=True)
        copy.write_bytes(file.read_bytes())
    damaged = tmp_path / "round-0.zip"
    damaged.write_bytes(damaged.read_bytes()[:size])
    with pytest.raises(ValueError, match=r"round-0\.zip is no FAMLE checkpoint, or it is damaged"):
        make_agent(**ONE_ROUND).meta_learn(SITUATIONS, folder=tmp_path)


def test_transitions_of_another_kind_are_not_taken_for_those_of_the_folder(
    make_agent: Make, transitions: Transitions, tmp_path: Path
) -> None:
    """A run on given transitions does not end with the model of others."""
    make_agent().meta_learn(transitions, folder=tmp_path)
    others = Transitions(
        transitions.obs[:4],
        transitions.action[:4],
        transitions.reward[:4],
        transitions.next_obs[:4],
        ("a", "b", "c", "d"),
    )
    with pytest.raises(ValueError, match="differs in"):
        make_agent().meta_learn(others, folder=tmp_path)


def reward_towards(goal: float) -> Callable[..., torch.Tensor]:
    return lambda obs, action, next_obs: -(next_obs[..., 0] - goal).abs()


def test_folder_knows_what_functions_do(make_agent: Make, tmp_path: Path) -> None:
    """The names are the same; what is simulated, and what is wanted, is not."""
    settings: dict[str, Any] = {**ONE_ROUND, "reward_fn": reward_towards(0.5)}

    def situations(angle: float) -> dict[str, Any]:
        broken = f"joint 0 sensor off by {angle} rad"
        return {
            "intact": lambda: gym.make("FamleReacher-v0"),
            "off": partial(gym.make, "FamleReacher-v0", situation=broken),
        }

    first = make_agent(**settings).meta_learn(situations(0.1), folder=tmp_path).dynamics
    for change, angle, differing in (({"reward_fn": reward_towards(0.6)}, 0.1, "reward_fn"), ({}, 0.2, "sources")):
        with pytest.raises(ValueError, match=rf"differs in: {differing}\."):
            make_agent(**settings | change).meta_learn(situations(angle), folder=tmp_path)
    again = make_agent(**settings | {"reward_fn": reward_towards(0.5)}).meta_learn(situations(0.1), folder=tmp_path)
    assert_same(again.dynamics, first)
