from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from benchmarks import identification
from benchmarks.identification import ADAPTATIONS, CANDIDATES, Args, accuracy, log_likelihood, main
from benchmarks.results import load
from famle_agent import FAMLE, Transitions
from famle_agent.adaptation.candidates import Candidates
from tests.helpers import simple_model


def test_accuracy_counts_the_windows_whose_situation_is_the_likeliest() -> None:
    candidates = Candidates.of(simple_model(n_situations=2), compose=False)
    log_p = torch.zeros(2, 6, 2)
    log_p[0, :, 0] = 1.0  # situation 0 is always named right
    log_p[1, :, 1] = torch.tensor([1.0, 1.0, 1.0, -9.0, -9.0, 1.0])  # situation 1 in one window of two
    assert accuracy(log_p, candidates, 3) == 0.75
    assert accuracy(log_p, candidates, 6) == 0.5


def test_swapped_situations_are_named_wrong(agent: FAMLE, transitions: Transitions) -> None:
    model, candidates = agent.model, Candidates.of(agent.model, compose=False)
    right = accuracy(log_likelihood(model, candidates, transitions), candidates, 50)
    swapped = replace(transitions, obs=transitions.obs[::-1].copy(), next_obs=transitions.next_obs[::-1].copy())
    assert accuracy(log_likelihood(model, candidates, swapped), candidates, 50) < 0.5 < right <= 1.0


def test_more_transitions_say_more(agent: FAMLE, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identification, "famle", lambda task: agent)
    main(Args(("reacher",), replicates=1, damages=2, windows=2, sizes=(2, 20), seen=(0, 20), jobs=1, out=tmp_path))
    named = load(tmp_path / "identification.csv")
    assert len(named) == 2 * len(CANDIDATES) * 2
    by_size = named[named["data"] == "random actions"].groupby("transitions")["accuracy"].mean()
    assert by_size[2] < by_size[20] <= 1.0
    errors = load(tmp_path / "prediction.csv")
    assert len(errors) == 2 * len(ADAPTATIONS) * 2
    after = errors.groupby("transitions")["error_1_step"].median()
    assert 0.0 < after[20] < after[0]
    assert {"command", "commit", "versions", "wall_seconds"} <= set(errors)
