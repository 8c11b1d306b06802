from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest

from famle_agent import AMPC, AMPCMAML, FAMLE, Config
from famle_agent.adaptation.settings import Window
from famle_agent.agents.presets import known_robots

RIVALS: dict[str, tuple[Any, dict[str, Any]]] = {
    "ampc": (AMPC, {}),
    "reptile": (AMPCMAML, {}),
    "first-order-maml": (AMPCMAML, {"meta_learner": "first-order-maml"}),
    "maml": (AMPCMAML, {"meta_learner": "maml"}),
}
every_rival = pytest.mark.parametrize("rival", RIVALS)


def config_of(rival: str, env: gym.Env[Any, Any], mode: str = "ours", **overrides: Any) -> Config:
    """That of a rival's agent."""
    cls, own = RIVALS[rival]
    config: Config = cls(env, mode, device="cpu", pretrained=False, **own, **overrides).config
    return config


@every_rival
@pytest.mark.parametrize("mode", ["ours", "paper", "original"])
def test_rivals_have_no_embeddings_in_any_mode(make_env: Callable[..., Any], rival: str, mode: str) -> None:
    config = config_of(rival, make_env(), mode)
    model, adaptation, training = config.model, config.adaptation, config.training
    assert (model.embedding_dim, model.interaction_rank, model.gate_actions) == (1, 0, False)
    assert (adaptation.compose, type(adaptation.evidence)) == (False, Window)
    assert adaptation.gradient is not None
    assert adaptation.gradient.embedding_lr == 0
    assert training.joint is None or training.joint.embedding_lr == 0
    assert training.inner_loop is None or training.inner_loop.embedding_lr == 0
    if rival == "ampc":
        assert config.iterations(config.last_round) == 0
    if mode != "ours":
        assert adaptation.warm_start == (rival == "ampc")


@pytest.mark.parametrize("robot", [name for name, robot in known_robots().items() if robot.rivals])
def test_rivals_have_settings_of_their_own(make_env: Callable[..., Any], robot: str) -> None:
    entry = known_robots()[robot]
    env = make_env(entry.env_id or "Pendulum-v1")
    assert FAMLE(env, device="cpu", pretrained=False).config == entry.config("ours")
    assert {mode: set(rivals) for mode, rivals in entry.rivals.items()} == {
        "ours": set(RIVALS),
        "paper": {"first-order-maml", "maml"},
    }
    for rival, (cls, own) in RIVALS.items():
        for mode in ("ours", "paper"):
            tuned = entry.rivals[mode].get(rival, {})
            expected = Config.of({**entry.modes[mode], **tuned, **cls.implied, **own})
            assert config_of(rival, env, mode) == expected
        assert entry.rivals["ours"][rival]


def test_settings_that_were_tuned_for_a_rival_can_be_overridden(make_env: Callable[..., Any]) -> None:
    tuned = known_robots()["reacher"].rivals["ours"]["ampc"]
    config = config_of("ampc", make_env(), adapt_lr=0.5, memory_size=7)
    assert tuned["adapt_lr"] != 0.5
    assert config.adaptation.gradient is not None
    assert (config.adaptation.gradient.lr, config.adaptation.memory_size) == (0.5, 7)


def test_meta_learners_of_an_unknown_environment_have_settings(make_env: Callable[..., Any]) -> None:
    for rival in ("first-order-maml", "maml"):
        inner_loop = config_of(rival, make_env("Pendulum-v1")).training.inner_loop
        assert inner_loop is not None
        assert inner_loop.optimizer == "sgd"


def test_meta_learner_of_a_rival_is_refused_by_the_others(make_env: Callable[..., Any]) -> None:
    for cls in (FAMLE, AMPC):
        with pytest.raises(ValueError, match="meta_learner"):
            cls(make_env(), device="cpu", meta_learner="maml")
