from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.performance import PARTS, Args, main
from benchmarks.raw_cost import OneByOne
from benchmarks.results import load
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.gradient_steps import InnerLoop

SMALL = {"repeats": 2, "steps": 15, "batches": (1, 2), "embeddings": (2, 4), "transitions": 10}


def test_all_parts_are_timed_and_stored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(Args(("ant",), out=tmp_path, **SMALL))  # type: ignore[arg-type]
    table = load(tmp_path / "performance.csv")
    assert set(table["part"]) == set(PARTS)
    figures = table.set_index(["part", "figure"])["value"]
    growths = figures[["growth" in figure for _, figure in figures.index]]
    in_time = figures[[figure == "within the period" for _, figure in figures.index]]
    assert (figures.drop(growths.index).drop(in_time.index) > 0.0).all()
    assert in_time.between(0.0, 1.0).all()
    assert np.isfinite(growths).all()
    ratio = figures["planning", "ours: plan (ms)"] / figures["planning", "ours: bare products (ms)"]
    assert figures["planning", "ours: plan / bare products"] == pytest.approx(ratio)
    seconds = figures["environment", "mujoco: simulated second (ms)"]
    assert seconds == pytest.approx(figures["environment", "mujoco: step (ms)"] * 60.6, rel=1e-3)  # 60.6 Hz
    assert table["machine"].str.contains("cores").all()
    assert "ant, planning" in capsys.readouterr().out
    main(Args(("ant",), ("environment",), out=tmp_path, **SMALL))  # type: ignore[arg-type]
    assert len(load(tmp_path / "performance.csv")) == len(table)  # measured anew, in place of the old figures


def test_sequential_port_learns() -> None:
    torch.manual_seed(0)
    model = Dynamics(obs_dim=2, action_dim=1, n_situations=3, hidden=(16,))
    obs, action = torch.randn(3, 40, 2), torch.rand(3, 40, 1)
    data = model.encode(obs, action, obs + action * torch.tensor([1.0, -1.0, 0.5])[:, None, None])
    port = OneByOne(model, data, InnerLoop(steps=20, lr=0.05), batch_size=32)

    def loss() -> float:
        h = port.H[:, None].expand(-1, 40, -1)
        return float((port.theta(torch.cat([data.x, h], dim=-1)) - data.y).square().mean().detach())

    before = loss()
    for _ in range(30):
        port.situation()
    assert loss() < 0.5 * before


def test_nothing_else_can_be_timed() -> None:
    with pytest.raises(ValueError, match=r"nothing to time of moon\. Known: reacher, ant"):
        Args(robots=("moon",))
    with pytest.raises(ValueError, match="Known: planning"):
        Args(parts=("planing",))
