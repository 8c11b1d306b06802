from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from famle_agent import FAMLE, Hyperparameters
from famle_agent.agents.presets import known_robots, robot_of
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.planning import ICEM, MPPI, RandomShooting
from famle_agent.training.maml import MAML
from famle_agent.training.multitask import JointTraining

MODES = ("ours", "paper")
every_robot = pytest.mark.parametrize("robot", list(known_robots()))
every_mode = pytest.mark.parametrize("mode", MODES)


@every_robot
@every_mode
def test_file_of_every_robot_builds_all_parts(robot: str, mode: str) -> None:
    settings = known_robots()[robot].hyperparameters(mode)
    assert settings.make_planner().horizon == settings.horizon
    assert settings.reptile().iterations == settings.meta_iterations
    assert settings.inner_loop().steps == settings.inner_steps
    assert settings.adaptation(seen=1).optimizer == settings.inner_optimizer


@every_robot
def test_robot_of_every_file_is_registered(robot: str) -> None:
    env_id = known_robots()[robot].env_id
    assert robot == "default" if not env_id else gym.spec(env_id).id == env_id


@every_robot
@every_mode
def test_file_names_no_setting_that_is_gone(robot: str, mode: str) -> None:
    entry, known = known_robots()[robot], set(Hyperparameters().to_dict())
    assert set(entry.modes) - {"original"} == set(MODES)
    assert set(entry.modes[mode]) <= known
    assert set(entry.rivals) <= set(entry.modes)
    for rivals in entry.rivals.values():
        assert all(set(settings) <= known for settings in rivals.values())


@every_robot
def test_paper_mode_has_the_settings_of_the_paper(robot: str) -> None:
    paper = known_robots()[robot].hyperparameters("paper")
    assert paper.planner == "random_shooting"
    assert isinstance(paper.make_planner(), RandomShooting)
    assert paper.inner_optimizer == "sgd"
    assert paper.gate_actions is False
    assert paper.compose is False
    assert (paper.hazard, paper.likelihood_power) == (0, 1)
    assert (paper.interaction_rank, paper.members, paper.degrees_of_freedom) == (0, 1, 0)
    assert (paper.rounds, paper.joint_iterations, paper.round_iterations) == (0, 0, 0)
    assert paper.meta_batch_size == 1
    assert paper.action_hold == 1
    assert paper.forget_at_reset is False


def test_robot_of_an_environment() -> None:
    assert robot_of("FamleReacher-v0") is known_robots()["reacher"]
    assert robot_of("FamleAnt-v0") is known_robots()["ant"]
    for unknown in ("Pendulum-v1", None, ""):
        assert robot_of(unknown) is known_robots()["default"]


@pytest.mark.parametrize(("planner", "kind"), [("icem", ICEM), ("mppi", MPPI), ("random_shooting", RandomShooting)])
def test_planner_gets_its_settings(planner: str, kind: type) -> None:
    made = Hyperparameters.from_dict(
        {"planner": planner, "horizon": 7, "candidates": 9, "planner_iterations": 4, "init_std": 0.3}
    ).make_planner()
    assert type(made) is kind
    assert (made.horizon, made.candidates) == (7, 9)
    if kind is not RandomShooting:
        assert (made.iterations, made.init_std) == (4, 0.3)


def test_iterations_of_the_rounds_add_up() -> None:
    settings = Hyperparameters(joint_iterations=100, round_iterations=20, meta_iterations=7)
    assert settings.iterations(0) == 107
    assert settings.iterations(3) == 167
    assert settings.iterations(3, last=False) == 160
    assert [settings.joint_training(i).iterations for i in range(3)] == [100, 20, 20]


def test_joint_training_gets_its_settings() -> None:
    made = Hyperparameters(joint_iterations=3, joint_lr=0.1, joint_embedding_lr=0.2, joint_batch_size=9)
    assert made.joint_training(0) == JointTraining(3, lr=0.1, embedding_lr=0.2, batch_size=9)


@pytest.mark.parametrize(
    ("change", "alike"),
    [
        ({}, True),
        ({"horizon": 3, "candidates": 7, "adapt_every": 1, "compose": True, "planner": "mppi"}, True),
        ({"hazard": 0.1, "likelihood_power": 0.5}, True),
        ({"hidden": (3,)}, False),
        ({"members": 2}, False),
        ({"joint_iterations": 1}, False),
        ({"inner_steps": 1, "horizon": 3}, False),
        ({"transitions_per_situation": 1}, False),
        ({"keep_adapting": True, "adapt_at_reset": True, "clamp_predictions": True, "planning_reward": "r"}, True),
        ({"adapt_epochs": 2, "adapt_batch_size": 8, "adapt_optimizer": "sgd"}, True),
        ({"meta_learner": "maml"}, False),
        ({"query_size": 3}, False),
    ],
)
def test_settings_of_the_life_on_a_robot_do_not_matter_for_what_was_learnt(change: dict[str, Any], alike: bool) -> None:
    expected = [] if alike else [name for name in change if name != "horizon"]
    assert Hyperparameters().learnt_otherwise(Hyperparameters.from_dict(change)) == expected
    assert Hyperparameters.from_dict(change).learnt_otherwise(Hyperparameters()) == expected


def test_adaptation_inherits_what_is_not_said_otherwise() -> None:
    settings = Hyperparameters(inner_steps=11, inner_lr=0.1, embedding_lr=0.2)
    assert settings.adaptation(seen=100) == settings.inner_loop()
    own = Hyperparameters(adapt_steps=0, adapt_lr=0.0, adapt_embedding_lr=0.5).adaptation(seen=100)
    assert (own.steps, own.lr, own.embedding_lr) == (0, 0.0, 0.5)
    assert Hyperparameters(adapt_decay=3.0).adaptation(seen=100) == replace(Hyperparameters().inner_loop(), decay=3.0)


@given(st.integers(0, 5000), st.integers(1, 300), st.integers(1, 50))
def test_epochs_pass_as_often_through_what_was_seen(seen: int, batch_size: int, epochs: int) -> None:
    settings = Hyperparameters(adapt_epochs=epochs, adapt_batch_size=batch_size, adapt_steps=7)
    assert settings.adaptation(seen).steps == epochs * math.ceil(seen / batch_size)
    assert Hyperparameters(adapt_batch_size=batch_size, adapt_steps=7).adaptation(seen).steps == 7


def test_epochs_of_the_whole_memory_are_refused() -> None:
    with pytest.raises(ValueError, match="adapt_epochs needs an adapt_batch_size; adapt_steps counts steps"):
        Hyperparameters(adapt_epochs=1)


def test_adaptation_has_an_optimiser_of_its_own() -> None:
    settings = Hyperparameters(inner_optimizer="sgd", adapt_optimizer="adam", adapt_lr=0.5, adapt_embedding_lr=0.25)
    assert settings.adaptation(seen=1) == InnerLoop(settings.inner_steps, 0.5, 0.25, "adam")
    assert (
        settings.inner_loop().optimizer == Hyperparameters(inner_optimizer="sgd").adaptation(seen=1).optimizer == "sgd"
    )


@pytest.mark.parametrize("first_order", [False, True])
def test_maml_gets_its_settings(first_order: bool) -> None:
    name = "first-order-maml" if first_order else "maml"
    sizes = {"meta_batch_size": 3, "batch_size": 4, "query_size": 5}
    made = Hyperparameters(meta_learner=name, meta_iterations=7, meta_lr=0.1, **sizes).maml()
    assert made == MAML(iterations=7, meta_lr=0.1, **sizes, first_order=first_order)


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "hidden": st.lists(st.integers(1, 300), min_size=1, max_size=4),
            "inner_lr": st.floats(0, 1),
            "adapt_steps": st.none() | st.integers(0, 100),
            "adapt_lr": st.none() | st.floats(0, 1),
            "meta_iterations": st.integers(1, 10_000),
            "adapt_every": st.integers(0, 50),
            "planner": st.sampled_from(["icem", "mppi", "random_shooting"]),
            "gate_actions": st.booleans(),
            "noise_beta": st.floats(0, 4),
            "rounds": st.integers(0, 9),
            "members": st.integers(1, 9),
            "interaction_rank": st.integers(0, 9),
            "degrees_of_freedom": st.floats(0, 30) | st.integers(0, 30),
            "joint_iterations": st.integers(0, 9),
            "compose": st.booleans(),
            "meta_learner": st.sampled_from(["reptile", "first-order-maml", "maml"]),
            "query_size": st.integers(1, 100),
            "adapt_optimizer": st.sampled_from([None, "sgd", "adam"]),
            "adapt_at_reset": st.booleans(),
            "keep_adapting": st.booleans(),
            "clamp_predictions": st.booleans(),
            "planning_reward": st.text(max_size=5),
        },
    )
)
def test_settings_survive_json(values: dict[str, Any]) -> None:
    settings = Hyperparameters.from_dict(values)
    assert Hyperparameters.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings
    for name, value in values.items():
        assert getattr(settings, name) == (tuple(value) if name == "hidden" else value)


@pytest.mark.parametrize(
    ("name", "suggestion"), [("horizn", "horizon"), ("meta_iteration", "meta_iterations"), ("xyz", None)]
)
def test_unknown_setting_names_the_one_that_was_meant(name: str, suggestion: str | None) -> None:
    with pytest.raises(TypeError, match=f"no setting '{name}'") as caught:
        FAMLE("Pendulum-v1", device="cpu", **{name: 3})
    assert (f"Did you mean '{suggestion}'?" in str(caught.value)) == (suggestion is not None)
    assert "candidates" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("horizon", 0),
        ("candidates", 0),
        ("elites", -1),
        ("adapt_every", -1),
        ("adapt_steps", -2),
        ("inner_lr", -0.1),
        ("inner_lr", float("nan")),
        ("adapt_lr", -1e-9),
        ("memory_size", 0),
        ("meta_batch_size", 0),
        ("hidden", ()),
        ("hidden", (10, 0)),
        ("planner", "cem"),
        ("inner_optimizer", "lion"),
        ("noise_beta", -1.0),
        ("rounds", -1),
        ("hazard", -0.1),
        ("hazard", 1.0),
        ("hazard", float("nan")),
        ("likelihood_power", -0.5),
        ("round_transitions", 0),
        ("members", 0),
        ("interaction_rank", -1),
        ("degrees_of_freedom", -0.5),
        ("degrees_of_freedom", float("nan")),
        ("joint_iterations", -1),
        ("round_iterations", -1),
        ("joint_lr", -1e-3),
        ("joint_embedding_lr", -1e-3),
        ("joint_batch_size", 0),
        ("meta_iterations", -1),
        ("meta_learner", "mamml"),
        ("meta_learner", None),
        ("query_size", 0),
        ("adapt_epochs", -1),
        ("adapt_batch_size", -1),
        ("adapt_optimizer", "lion"),
    ],
)
def test_value_out_of_range_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        Hyperparameters.from_dict({name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("horizon", "10"),
        ("inner_lr", "fast"),
        ("gate_actions", 1),
        ("horizon", True),
        ("compose", 1),
        ("rounds", True),
        ("rounds", 1.5),
        ("members", 2.0),
        ("degrees_of_freedom", "3"),
        ("adapt_steps", 2.5),
        ("adapt_steps", "5"),
        ("adapt_lr", "0.1"),
        ("horizon", None),
        ("hidden", 64),
        ("hidden", "64"),
    ],
)
def test_value_of_the_wrong_type_is_refused(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=name):
        Hyperparameters.from_dict({name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("adapt_steps", None),
        ("adapt_steps", np.int64(3)),
        ("adapt_lr", np.float32(0.5)),
        ("adapt_lr", 1),
        ("hidden", [32]),
        ("hidden", np.array([32, 16])),
    ],
)
def test_numbers_of_any_kind_are_taken(name: str, value: Any) -> None:
    assert np.array_equal(getattr(Hyperparameters.from_dict({name: value}), name), value)


def test_validation_leaves_something_to_learn_from() -> None:
    with pytest.raises(ValueError, match="below memory_size, 50"):
        Hyperparameters(memory_size=50, validation_size=50)


def test_unknown_mode_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match="ours, paper, got 'best'"):
        FAMLE("Pendulum-v1", "best", device="cpu")


def test_overrides_win_over_the_file() -> None:
    settings = known_robots()["reacher"].hyperparameters("paper", planner="mppi", inner_steps=1)
    assert (settings.planner, settings.inner_steps) == ("mppi", 1)
    assert settings.inner_optimizer == "sgd"
    assert known_robots()["reacher"].hyperparameters("paper").planner == "random_shooting"
