from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import pytest

from famle_agent import AMPC, AMPCMAML, FAMLE, Hyperparameters
from famle_agent.agents.presets import known_robots

RIVALS: dict[str, tuple[Any, dict[str, Any]]] = {
    "ampc": (AMPC, {}),
    "reptile": (AMPCMAML, {}),
    "first-order-maml": (AMPCMAML, {"meta_learner": "first-order-maml"}),
    "maml": (AMPCMAML, {"meta_learner": "maml"}),
}
every_rival = pytest.mark.parametrize("rival", RIVALS)


def settings_of(rival: str, env: gym.Env[Any, Any], mode: str = "ours", **overrides: Any) -> Hyperparameters:
    """Those of a rival's agent."""
    cls, own = RIVALS[rival]
    settings: Hyperparameters = cls(env, mode, device="cpu", pretrained=False, **own, **overrides).hyperparameters
    return settings


@every_rival
@pytest.mark.parametrize("mode", ["ours", "paper", "original"])
def test_rivals_have_no_embeddings_in_any_mode(make_env: Callable[..., Any], rival: str, mode: str) -> None:
    settings = settings_of(rival, make_env(), mode)
    assert (settings.embedding_dim, settings.interaction_rank, settings.hazard) == (1, 0, 0)
    assert {settings.gate_actions, settings.compose, settings.spread_members} == {False}
    assert settings.embedding_lr == settings.joint_embedding_lr == settings.adaptation(seen=5).embedding_lr == 0
    if rival == "ampc":
        assert settings.rounds == settings.joint_iterations == settings.meta_iterations == 0
    if mode != "ours":
        assert settings.keep_adapting == (rival == "ampc")


@pytest.mark.parametrize("robot", [name for name, robot in known_robots().items() if robot.rivals])
def test_rivals_have_settings_of_their_own(make_env: Callable[..., Any], robot: str) -> None:
    entry = known_robots()[robot]
    env = make_env(entry.env_id or "Pendulum-v1")
    assert FAMLE(env, device="cpu", pretrained=False).hyperparameters == entry.hyperparameters("ours")
    assert {mode: set(rivals) for mode, rivals in entry.rivals.items()} == {
        "ours": set(RIVALS),
        "paper": {"first-order-maml", "maml"},
    }
    for rival, (cls, own) in RIVALS.items():
        for mode in ("ours", "paper"):
            tuned = entry.rivals[mode].get(rival, {})
            settings = settings_of(rival, env, mode)
            assert settings == entry.hyperparameters(mode, **{**tuned, **cls.implied, **own})
        tuned = entry.rivals["ours"][rival]
        assert tuned
        defaults = {name: getattr(Hyperparameters(), name) for name in tuned}
        assert {name: getattr(settings_of(rival, env, **defaults), name) for name in tuned} == defaults


def test_meta_learners_of_an_unknown_environment_have_settings(make_env: Callable[..., Any]) -> None:
    for rival in ("first-order-maml", "maml"):
        assert settings_of(rival, make_env("Pendulum-v1")).inner_loop().optimizer == "sgd"


def test_meta_learner_of_a_rival_is_refused_by_the_others(make_env: Callable[..., Any]) -> None:
    with pytest.raises((TypeError, ValueError), match="meta_learner"):
        FAMLE(make_env(), device="cpu", meta_learner="maml")
