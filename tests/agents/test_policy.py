"""Agents that learn a policy in simulation first."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from famle_agent import AMPC, FAMLE
from famle_agent.agents import meta_training
from famle_agent.training.policy_search import Search
from tests.training.test_policy_search import Reach

TINY: dict[str, Any] = {
    "device": "cpu",
    "policy_steps": 180,
    "policy_updates_per_step": 0.1,
    "policy_batch_size": 8,
    "policy_hidden": (8,),
    "policy_random_steps": 20,
    "hidden": (8,),
    "joint_iterations": 3,
    "horizon": 3,
    "candidates": 4,
    "elites": 2,
}
SITUATIONS = {"intact": lambda: Reach(1.0), "reversed": lambda: Reach(-1.0), "weak": lambda: Reach(0.3)}


def learnt(seed: int = 0, **overrides: Any) -> FAMLE:
    return FAMLE(Reach(1.0), seed=seed, **{**TINY, **overrides}).meta_learn(SITUATIONS, check=False)


def parameters_of(agent: FAMLE) -> dict[str, torch.Tensor]:
    world = agent.policy.world
    assert world is not None
    return {f"{part}.{name}": value for part, m in world.parts().items() for name, value in m.state_dict().items()}


def test_robot_that_nobody_tuned_learns_a_policy_by_default() -> None:
    config = FAMLE(Reach(1.0), device="cpu").config
    assert config.simulation.policy is not None
    assert config.training.joint is not None
    assert AMPC(Reach(1.0), device="cpu").config.simulation.policy is None
    assert FAMLE("reacher", device="cpu").config.simulation.policy is None


def test_agent_knows_model_reward_ends_and_policy() -> None:
    agent = learnt()
    assert agent.situations == tuple(SITUATIONS)
    assert set(agent.policy.world.parts()) == {"dynamics", "reward", "termination", "actor_critic"}  # type: ignore[union-attr]
    controller = agent.controller
    assert controller.guide is not None
    assert controller.objective.termination_fn is not None
    action, state = agent.predict(np.zeros((3, 1), np.float32))
    assert action.shape == (3, 1)
    assert agent.action_space.contains(agent.predict(np.zeros(1, np.float32), None)[0])
    agent.predict(np.ones((3, 1), np.float32), state)


def test_ends_and_rewards_that_are_known_are_not_learnt() -> None:
    agent = learnt(reward_fn=lambda s, a, s_next: -s_next[..., 0].abs(), termination_fn=lambda s: s[..., 0].abs() > 2.0)
    assert set(agent.policy.world.parts()) == {"dynamics", "actor_critic"}  # type: ignore[union-attr]
    assert agent.controller.objective.termination_fn is agent.policy.user_termination_fn


def test_ends_are_learnt_beside_a_policy_alone() -> None:
    """The paper's planner knows of none, though its robots may fall."""
    random_actions = {"policy_steps": 0, "transitions_per_situation": 60, "action_hold": 9}
    kept = {name: value for name, value in TINY.items() if not name.startswith("policy_")}
    agent = FAMLE(Reach(1.0), seed=0, **kept, **random_actions)
    data = agent.collect(SITUATIONS)
    assert data.ended.any()
    agent.meta_learn(data)
    assert set(agent.policy.world.parts()) == {"dynamics", "reward"}  # type: ignore[union-attr]
    assert agent.controller.objective.termination_fn is None


def test_ends_that_the_user_names_are_not_lost_with_a_file() -> None:
    file = io.BytesIO()
    learnt(termination_fn=lambda s: s[..., 0].abs() > 2.0).save(file)
    file.seek(0)
    with pytest.raises(ValueError, match=r"made with a termination_fn.*load\(\.\.\., termination_fn="):
        FAMLE.load(file, env=Reach(1.0), device="cpu")
    file.seek(0)
    loaded = FAMLE.load(file, env=Reach(1.0), device="cpu", termination_fn=lambda s: s[..., 0].abs() > 2.0)
    assert loaded.controller.objective.termination_fn is loaded.policy.user_termination_fn


def test_stored_agent_has_all_of_it() -> None:
    agent, file = learnt(), io.BytesIO()
    agent.save(file)
    file.seek(0)
    loaded = FAMLE.load(file, env=Reach(1.0), device="cpu")
    assert loaded.config == agent.config
    for name, value in parameters_of(agent).items():
        assert torch.equal(parameters_of(loaded)[name], value), name
    obs = np.full(1, 0.5, np.float32)
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], agent.predict(obs, deterministic=True)[0])


def test_same_seed_same_agent() -> None:
    one, same, other = (parameters_of(learnt(seed)) for seed in (0, 0, 1))
    assert all(torch.equal(value, same[name]) for name, value in one.items())
    assert any(not torch.equal(value, other[name]) for name, value in one.items())


def test_stopped_run_does_not_search_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    expected, searched = parameters_of(learnt()), list[Search]()

    class Watched(Search):
        def __init__(self, *args: Any) -> None:
            searched.append(self)
            super().__init__(*args)

    monkeypatch.setattr(meta_training, "Search", Watched)

    def stop(local: dict[str, Any], _: Any) -> bool:
        if "meta/joint_loss" in local["metrics"]:
            raise KeyboardInterrupt
        return True

    agents = [FAMLE(Reach(1.0), seed=0, **TINY) for _ in range(2)]
    with pytest.raises(KeyboardInterrupt):
        agents[0].meta_learn(SITUATIONS, callback=stop, folder=tmp_path, check=False)
    agents[1].meta_learn(SITUATIONS, folder=tmp_path, check=False)
    assert len(searched) == 1
    for name, value in expected.items():
        assert torch.equal(parameters_of(agents[1])[name], value), name


def test_agent_that_plans_no_better_than_nothing_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    agent = FAMLE(Reach(1.0), seed=0, verbose=1, reward_fn=lambda s, a, s_next: s_next[..., 0].abs(), **TINY)
    with pytest.warns(UserWarning, match=r"no better than doing nothing(.|\n)*policy_steps"):
        agent.meta_learn(SITUATIONS)
    found = agent.last_check
    assert found is not None
    assert not found.worth
    assert found.situations == tuple(SITUATIONS)
    assert "reversed" in capsys.readouterr().out
    nothing = np.array([-10 * abs(Reach(1.0).reset(seed=0)[0][0])] * 3)
    np.testing.assert_allclose(found.nothing, nothing, rtol=1e-5)
