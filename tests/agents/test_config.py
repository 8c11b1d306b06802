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

import famle_agent
from famle_agent import AMPC, FAMLE, Config
from famle_agent.adaptation.settings import Adaptation, Epochs, Filter, GradientSteps, Steps, Window
from famle_agent.agents.config import Rounds, Simulation
from famle_agent.agents.presets import known_robots, robot_of
from famle_agent.agents.world_model import ModelConfig
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.planning import ICEM, MPPI, RandomShooting
from famle_agent.training.maml import MAML
from famle_agent.training.multitask import JointTraining
from famle_agent.training.reptile import Reptile
from famle_agent.training.trainer import MetaTrainer

MODES = ("ours", "paper")
every_robot = pytest.mark.parametrize("robot", list(known_robots()))
every_mode = pytest.mark.parametrize("mode", MODES)


def settings(**values: Any) -> Config:
    """Settings of which each value that is given has an effect."""
    return Config.of(values, values.keys())


def inner_loop(config: Config, seen: int = 1) -> InnerLoop:
    """U^k on the robot."""
    assert config.adaptation.gradient is not None
    return config.adaptation.gradient.inner_loop(seen)


@every_robot
@every_mode
def test_file_of_every_robot_is_complete(robot: str, mode: str) -> None:
    entry = known_robots()[robot]
    config = entry.config(mode)
    assert config == Config.of(entry.modes[mode])
    assert Config.of(config.to_dict()) == config


@every_robot
def test_robot_of_every_file_is_registered(robot: str) -> None:
    env_id = known_robots()[robot].env_id
    assert robot == "default" if not env_id else gym.spec(env_id).id == env_id


@every_robot
@every_mode
def test_every_line_of_a_file_has_an_effect(robot: str, mode: str) -> None:
    entry = known_robots()[robot]
    assert set(entry.modes) - {"original"} == set(MODES)
    Config.of(entry.modes[mode], entry.modes[mode].keys())


@every_robot
def test_paper_mode_has_the_settings_of_the_paper(robot: str) -> None:
    paper = known_robots()[robot].config("paper")
    assert isinstance(paper.planner, RandomShooting)
    assert paper.simulation.rounds is None
    assert paper.simulation.action_hold == 1
    model, adaptation = paper.model, paper.adaptation
    assert (model.gate_actions, model.interaction_rank, model.members, model.degrees_of_freedom) == (False, 0, 1, 0)
    assert paper.training.joint is None
    assert isinstance(paper.training.meta_learner, Reptile)
    assert paper.training.meta_learner.meta_batch_size == 1
    assert paper.training.inner_loop is not None
    assert paper.training.inner_loop.optimizer == "sgd"
    assert (adaptation.compose, adaptation.likelihood_power, adaptation.evidence) == (False, 1, Window(0))
    assert adaptation.forget_at_reset is False
    assert inner_loop(paper) == paper.training.inner_loop


def test_robot_of_an_environment() -> None:
    assert robot_of("FamleReacher-v0") is known_robots()["reacher"]
    assert robot_of("FamleAnt-v0") is known_robots()["ant"]
    for unknown in ("Pendulum-v1", None, ""):
        assert robot_of(unknown) is known_robots()["default"]


def test_keywords_build_the_parts_they_name() -> None:
    built = settings(
        **{"transitions_per_situation": 7, "rounds": 2, "round_transitions": 8, "round_iterations": 9},
        **{"joint_iterations": 3, "joint_lr": 0.1, "joint_embedding_lr": 0.2, "joint_batch_size": 9},
        **{"hidden": [3, 4], "members": 2, "meta_iterations": 5, "meta_lr": 0.3, "inner_steps": 6, "inner_lr": 0.4},
        **{"adapt_every": 1, "hazard": 0.1, "adapt_epochs": 2, "adapt_batch_size": 8, "adapt_optimizer": "sgd"},
        **{"planner": "mppi", "horizon": 7, "candidates": 9, "planner_iterations": 4, "temperature": 0.3},
    )
    assert built == Config(
        simulation=Simulation(7, rounds=Rounds(2, 8, 9)),
        model=ModelConfig(hidden=(3, 4), members=2),
        training=MetaTrainer(
            JointTraining(3, lr=0.1, embedding_lr=0.2, batch_size=9),
            Reptile(5, meta_lr=0.3),
            InnerLoop(6, 0.4, optimizer="adam"),
        ),
        adaptation=Adaptation(
            every=1, evidence=Filter(0.1), gradient=GradientSteps(Epochs(2), lr=0.4, optimizer="sgd", batch_size=8)
        ),
        planner=MPPI(7, 9, iterations=4, temperature=0.3),
    )


@pytest.mark.parametrize("first_order", [False, True])
def test_maml_gets_its_settings(first_order: bool) -> None:
    name = "first-order-maml" if first_order else "maml"
    sizes = {"meta_batch_size": 3, "batch_size": 4, "query_size": 5}
    built = settings(meta_learner=name, meta_iterations=7, meta_lr=0.1, **sizes)
    assert built.training.meta_learner == MAML(iterations=7, meta_lr=0.1, **sizes, first_order=first_order)


def test_iterations_of_the_rounds_add_up() -> None:
    config = settings(rounds=3, joint_iterations=100, round_iterations=20, meta_iterations=7)
    assert config.last_round == 3
    assert config.iterations(0) == 107
    assert config.iterations(3) == 167
    assert config.iterations(3, last=False) == 160
    joint = [config.trainer(number, last=False).joint for number in range(3)]
    assert [part.iterations for part in joint if part is not None] == [100, 20, 20]
    assert config.trainer(3, last=True).iterations == 27


@pytest.mark.parametrize(
    ("change", "differing"),
    [
        ({}, []),
        ({"horizon": 3, "candidates": 7, "adapt_every": 1, "compose": True, "planner": "mppi"}, []),
        ({"hazard": 0.1, "likelihood_power": 0.5}, []),
        ({"warm_start": True, "adapt_at_reset": True, "clamp_predictions": True, "planning_reward": "r"}, []),
        ({"adapt_epochs": 2, "adapt_batch_size": 8, "adapt_optimizer": "sgd"}, []),
        ({"hidden": (3,)}, ["hidden"]),
        ({"members": 2}, ["members"]),
        ({"inner_steps": 1, "horizon": 3}, ["inner_steps"]),
        ({"transitions_per_situation": 1}, ["transitions_per_situation"]),
        ({"joint_iterations": 1}, ["joint_iterations", "joint_lr", "joint_embedding_lr", "joint_batch_size"]),
        ({"meta_learner": "maml"}, ["embedding_meta_lr", "query_size", "meta_learner"]),
    ],
)
def test_settings_of_the_life_on_a_robot_do_not_matter_for_what_was_learnt(
    change: dict[str, Any], differing: list[str]
) -> None:
    assert set(Config().learnt_otherwise(settings(**change))) == set(differing)
    assert set(settings(**change).learnt_otherwise(Config())) == set(differing)


def test_adaptation_inherits_what_is_not_said_otherwise() -> None:
    config = settings(inner_steps=11, inner_lr=0.1, embedding_lr=0.2)
    assert inner_loop(config) == config.training.inner_loop
    own = inner_loop(settings(adapt_steps=3, adapt_lr=0.0, adapt_embedding_lr=0.5))
    assert (own.steps, own.lr, own.embedding_lr) == (3, 0.0, 0.5)
    assert inner_loop(settings(inner_optimizer="sgd")).optimizer == "sgd"
    assert inner_loop(settings(inner_optimizer="sgd", adapt_optimizer="adam")).optimizer == "adam"


def test_no_steps_are_no_gradient() -> None:
    assert settings(adapt_steps=0).adaptation.gradient is None
    assert GradientSteps().length == Steps()


@given(st.integers(0, 5000), st.integers(1, 300), st.integers(1, 50))
def test_epochs_pass_as_often_through_what_was_seen(seen: int, batch_size: int, epochs: int) -> None:
    passes = settings(adapt_epochs=epochs, adapt_batch_size=batch_size)
    assert inner_loop(passes, seen).steps == epochs * math.ceil(seen / batch_size)
    assert inner_loop(settings(adapt_batch_size=batch_size, adapt_steps=7), seen).steps == 7


def test_epochs_of_the_whole_memory_are_refused() -> None:
    with pytest.raises(ValueError, match="adapt_epochs needs an adapt_batch_size; adapt_steps counts steps"):
        settings(adapt_epochs=1)


VALUES = {
    "hidden": st.lists(st.integers(1, 300), min_size=1, max_size=4),
    "inner_lr": st.floats(0, 1),
    "adapt_steps": st.none() | st.integers(0, 100),
    "adapt_lr": st.none() | st.floats(0, 1),
    "meta_iterations": st.integers(0, 10_000),
    "adapt_every": st.integers(0, 50),
    "planner": st.sampled_from(["icem", "mppi", "random_shooting"]),
    "gate_actions": st.booleans(),
    "noise_beta": st.floats(0, 4),
    "rounds": st.integers(0, 9),
    "members": st.integers(1, 9),
    "interaction_rank": st.integers(0, 9),
    "degrees_of_freedom": st.floats(0, 30) | st.integers(0, 30),
    "compose": st.booleans(),
    "hazard": st.floats(0, 0.9),
    "meta_learner": st.sampled_from(["reptile", "first-order-maml", "maml"]),
    "query_size": st.integers(1, 100),
    "adapt_optimizer": st.sampled_from([None, "sgd", "adam"]),
    "adapt_at_reset": st.booleans(),
    "warm_start": st.booleans(),
    "clamp_predictions": st.booleans(),
    "planning_reward": st.text(max_size=5),
}


@given(st.fixed_dictionaries({"joint_iterations": st.integers(1, 9)}, optional=VALUES))
def test_settings_survive_json(values: dict[str, Any]) -> None:
    config = Config.of(values)
    stored = json.loads(json.dumps(config.to_dict()))
    assert Config.of(stored) == config
    for name in values.keys() & stored.keys():
        if values[name] is not None:
            assert stored[name] == values[name]


IDLE = [
    ({"planner": "random_shooting", "elites": 3}, "elites needs planner='icem'"),
    ({"temperature": 0.3}, "temperature needs planner='mppi'"),
    ({"round_transitions": 3}, "round_transitions needs rounds"),
    ({"joint_lr": 0.1}, "joint_lr needs joint_iterations"),
    ({"meta_iterations": 0, "meta_lr": 0.1}, "meta_lr needs meta_iterations"),
    ({"query_size": 3}, "query_size needs meta_iterations and a meta_learner that is MAML"),
    ({"meta_learner": "maml", "embedding_meta_lr": 0.3}, "embedding_meta_lr needs"),
    ({"hazard": 0.1, "selection_size": 3}, "selection_size needs .* no hazard"),
    ({"adapt_every": 0, "memory_size": 3}, "memory_size needs adapt_every or adapt_at_reset"),
    ({"adapt_steps": 0, "adapt_lr": 0.1}, "adapt_lr needs .* adapt_steps"),
    ({"adapt_epochs": 1, "adapt_batch_size": 8, "adapt_steps": 3}, "adapt_steps needs .* no adapt_epochs"),
    ({"meta_iterations": 0, "adapt_steps": 3, "inner_steps": 3}, "inner_steps needs"),
]


@pytest.mark.parametrize(("values", "message"), IDLE)
def test_setting_without_an_effect_is_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        settings(**values)
    Config.of(values)  # as a file of an earlier version has it
    Config.of({**Config().to_dict(), "elites": 0, "planner": "mppi"}, {"elites"})  # asks for nothing


@pytest.mark.parametrize(
    "values",
    [
        {"round_transitions": 0, "rounds": 1, "joint_iterations": 1},
        {"joint_batch_size": 0, "joint_iterations": 1},
        {"query_size": 0, "meta_learner": "maml"},
    ],
)
def test_nothing_is_not_enough_where_it_has_an_effect(values: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(values))} must be at least 1, got 0"):
        settings(**values)


def test_rounds_without_joint_training_are_refused() -> None:
    """Algorithm 1 comes in the last round alone, so that the agent would plan with an untrained network until then."""
    with pytest.raises(ValueError, match="give joint_iterations and round_iterations too, or rounds=0"):
        settings(rounds=2)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("policy_hidden", ()),
        ("policy_hidden", (8, 0)),
        ("policy_interaction_rank", 0),
        ("policy_untold", 1.5),
        ("discount", 1.0),
    ],
)
def test_policy_out_of_range_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        Config.of({"policy_steps": 100, name: value})


def test_rounds_beside_a_policy_are_refused() -> None:
    """They would plan without it, and without what it knows of ends."""
    with pytest.raises(ValueError, match="give one of them, and 0 for the other"):
        settings(rounds=2, joint_iterations=3, policy_steps=100)


def test_setting_that_an_agent_implies_is_refused() -> None:
    with pytest.raises(ValueError, match="gate_actions is False in every AMPC; leave it out"):
        AMPC("Pendulum-v1", device="cpu", gate_actions=True)
    assert AMPC("Pendulum-v1", device="cpu", gate_actions=False).config.model.gate_actions is False


def test_nested_settings_are_taken_as_they_are() -> None:
    config = Config(planner=RandomShooting(3, 7), adaptation=Adaptation(gradient=None))
    assert FAMLE("Pendulum-v1", device="cpu", config=config).config == config
    changed = FAMLE("Pendulum-v1", device="cpu", config=config, horizon=4).config
    assert changed == replace(config, planner=RandomShooting(4, 7))
    with pytest.raises(ValueError, match="horizon must be at least 1, got 0"):
        Config(planner=RandomShooting(0, 7))


def test_old_names_go_on_working() -> None:
    with pytest.warns(DeprecationWarning, match="keep_adapting is called warm_start"):
        assert settings(keep_adapting=True) == settings(warm_start=True)
    assert Config.of({"spread_members": True, "posterior_sampling": True}) == Config()  # as in files
    assert Config.of({"adapt_decay": 0.0}) == Config()
    with pytest.raises(TypeError, match="no setting 'adapt_decay'"):
        Config.of({"adapt_decay": 0.5})  # which nothing does any more
    for gone in ("posterior_sampling", "spread_members"):
        with pytest.raises(TypeError, match=f"no setting '{gone}'. It is gone; leave it out"):
            settings(**{gone: True})
    with pytest.warns(DeprecationWarning, match="Config"):
        assert famle_agent.Hyperparameters(horizon=3) == Config.of({"horizon": 3})
    agent = FAMLE("Pendulum-v1", device="cpu", horizon=3)
    with pytest.warns(DeprecationWarning, match="config"):
        assert agent.hyperparameters.horizon == 3


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
        ("members", 0),
        ("interaction_rank", -1),
        ("degrees_of_freedom", -0.5),
        ("degrees_of_freedom", float("nan")),
        ("joint_iterations", -1),
        ("round_iterations", -1),
        ("joint_lr", -1e-3),
        ("joint_embedding_lr", -1e-3),
        ("meta_iterations", -1),
        ("meta_learner", "mamml"),
        ("adapt_epochs", -1),
        ("adapt_batch_size", -1),
        ("adapt_optimizer", "lion"),
    ],
)
def test_value_out_of_range_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        settings(**{name: value})


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
        ("meta_learner", None),
        ("hidden", 64),
        ("hidden", "64"),
    ],
)
def test_value_of_the_wrong_type_is_refused(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=name):
        settings(**{name: value})


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
    assert settings(**{name: value}) == Config.of({} if value is None else {name: value})


def test_validation_leaves_something_to_learn_from() -> None:
    with pytest.raises(ValueError, match="below memory_size, 50"):
        settings(memory_size=50, validation_size=50)


def test_unknown_mode_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match="ours, paper, got 'best'"):
        FAMLE("Pendulum-v1", "best", device="cpu")


def test_overrides_win_over_the_file() -> None:
    config = known_robots()["reacher"].config("paper", planner="mppi", inner_steps=1)
    assert isinstance(config.planner, MPPI)
    assert config.training.inner_loop == InnerLoop(1, 0.05, 0.5, "sgd")
    assert isinstance(known_robots()["reacher"].config("paper").planner, RandomShooting)
    assert isinstance(known_robots()["reacher"].config("ours").planner, ICEM)
