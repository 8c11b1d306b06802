"""The ant's upper line, learnt within seconds."""

from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import ant_informed
from benchmarks.methods import shipped
from benchmarks.task import Task
from famle_agent import FAMLE
from famle_agent.agents.config import Config
from famle_agent.training.multitask import JointTraining
from famle_agent.training.trainer import MetaTrainer
from famle_envs import Situation

BROKEN = Situation(motor_gain=(1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0), orientation_error=1.0)
N = 30


@pytest.fixture
def collected(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The situations of the robots of which little was collected."""
    seen: list[Any] = []
    collect = ant_informed.collect
    others = FAMLE("ant", seed=0, device="cpu", pretrained=False, transitions_per_situation=N).collect()

    def watch(*args: Any, **kwargs: Any) -> Any:
        seen.append((args[0][0]().unwrapped.situation, args[2]))
        return collect(*args, **kwargs)

    monkeypatch.setattr(ant_informed, "collect", watch)
    monkeypatch.setattr(ant_informed, "simulated_data", lambda task: others)
    monkeypatch.setattr(ant_informed, "_IDENTIFIES", 40)
    few = MetaTrainer(JointTraining(40, 1e-3, 0.03, 512), None, None)
    monkeypatch.setattr(Config, "trainer", lambda self, number, last: few)
    return seen


def test_informed_ant_knows_the_test_robot_alone(collected: list[Any], tmp_path: Path) -> None:
    agent = ant_informed.informed(Task("ant", 0, BROKEN, tmp_path))
    model, before = agent.model, shipped(Task("ant", 0, BROKEN, tmp_path)).model
    assert agent.situations == (BROKEN.label,)
    assert model.n_situations == 1
    assert collected == [(BROKEN, 20), (BROKEN, 10)]
    learnt = [not torch.equal(model.theta[name], before.theta[name]) for name in before.theta]
    assert all(learnt)
    near = (model.embeddings - before.embeddings).norm(dim=2).mean(dim=0)
    assert near.argmin() != 0  # of all trained embeddings not the intact robot's is the nearest


def test_informed_ant_learns_once(collected: list[Any], tmp_path: Path) -> None:
    first, again = (ant_informed.informed(Task("ant", 0, BROKEN, tmp_path)) for _ in range(2))
    assert len(collected) == 2
    assert torch.equal(first.model.embeddings, again.model.embeddings)
