from __future__ import annotations

import json
from typing import Any

import gymnasium as gym
import pytest
from hypothesis import given
from hypothesis import strategies as st

from famle_agent import FAMLE, Hyperparameters
from famle_agent.hyperparameters import known_robots, robot_of
from famle_agent.planning import ICEM, MPPI, RandomShooting

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
    assert settings.adaptation().optimizer == settings.inner_optimizer


@every_robot
def test_robot_of_every_file_is_registered(robot: str) -> None:
    env_id = known_robots()[robot].env_id
    assert robot == "default" if not env_id else gym.spec(env_id).id == env_id


@every_robot
@every_mode
def test_file_names_no_setting_that_is_gone(robot: str, mode: str) -> None:
    assert set(known_robots()[robot].modes) == set(MODES)
    assert set(known_robots()[robot].modes[mode]) <= set(Hyperparameters().to_dict())


@every_robot
def test_paper_mode_has_the_settings_of_the_paper(robot: str) -> None:
    paper = known_robots()[robot].hyperparameters("paper")
    assert paper.planner == "random_shooting"
    assert isinstance(paper.make_planner(), RandomShooting)
    assert paper.inner_optimizer == "sgd"
    assert paper.gate_actions is False
    assert paper.meta_batch_size == 1
    assert paper.action_hold == 1
    assert paper.forget_at_reset is False


def test_robot_of_an_environment() -> None:
    assert robot_of("FamleReacher-v0") is known_robots()["reacher"]
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


def test_adaptation_inherits_what_is_not_said_otherwise() -> None:
    settings = Hyperparameters(inner_steps=11, inner_lr=0.1, embedding_lr=0.2)
    assert settings.adaptation() == settings.inner_loop()
    own = Hyperparameters(adapt_steps=0, adapt_lr=0.0, adapt_embedding_lr=0.5).adaptation()
    assert (own.steps, own.lr, own.embedding_lr) == (0, 0.0, 0.5)


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
    ],
)
def test_value_out_of_range_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name):
        Hyperparameters.from_dict({name: value})


@pytest.mark.parametrize(
    ("name", "value"), [("horizon", "10"), ("inner_lr", "fast"), ("gate_actions", 1), ("horizon", True)]
)
def test_value_of_the_wrong_type_is_refused(name: str, value: Any) -> None:
    with pytest.raises(TypeError, match=name):
        Hyperparameters.from_dict({name: value})


def test_unknown_mode_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match="ours, paper, got 'best'"):
        FAMLE("Pendulum-v1", "best", device="cpu")


def test_overrides_win_over_the_file() -> None:
    settings = known_robots()["reacher"].hyperparameters("paper", planner="mppi", inner_steps=1)
    assert (settings.planner, settings.inner_steps) == ("mppi", 1)
    assert settings.inner_optimizer == "sgd"
    assert known_robots()["reacher"].hyperparameters("paper").planner == "random_shooting"
