"""What a robot's own errors say: what lasts in them, what the noise is, and whether it is like anything known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from famle_agent import FAMLE
from famle_agent.adaptation.adapters import EmbeddingAdapter
from famle_agent.adaptation.belief import Belief
from famle_agent.adaptation.diagnosis import Diagnosis
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.posterior import updated_bias, updated_excess
from famle_agent.adaptation.settings import Adaptation, Filter, Window
from famle_agent.models.dynamics import Dynamics
from tests.helpers import random_transitions, simple_model

FILTER = Adaptation(evidence=Filter(1e-4), gradient=None, compose=True)


def seen(
    model: Dynamics, settings: Adaptation, noise: float, steps: int = 150, robots: int = 2, lasting: float = 0.0
) -> Belief:
    """What robots of situation 1 believe whose errors are ``noise`` times those that were fitted, and last in part."""
    adapter = EmbeddingAdapter(model, settings, seed=0)
    belief, nothing = adapter.initial(robots), torch.ones(robots, dtype=torch.bool)
    C = belief.log_posterior.shape[1]
    memory = Memory.empty(robots, 200, model.obs_dim, model.action_dim, C, torch.device("cpu"), 10)
    h = model.embeddings_of(torch.ones(robots, dtype=torch.long))
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        obs, action, _ = (values[:, 0] for values in random_transitions(model, robots, 1))
        expected = model.predict(obs[:, None], action[:, None], h).mean(dim=1)[:, 0]
        error = noise * model.noise_std.mean(dim=0) * (lasting + torch.randn(obs.shape, generator=generator))
        next_obs = expected + error * model.target_std
        evidence = adapter.judge(belief, obs, action, next_obs)
        memory = memory.add(obs, action, next_obs, evidence.log_p, evidence.own_log_p, nothing)
        belief = adapter.infer(memory, belief, evidence, nothing)
    return belief


@pytest.fixture
def model() -> Dynamics:
    torch.manual_seed(1)
    made = simple_model(n_situations=3)
    made.noise_std.fill_(0.3)
    return made


@pytest.mark.parametrize("noise", [1.0, 4.0])
@torch.no_grad()
def test_excess_is_the_noise_of_the_robot(model: Dynamics, noise: float) -> None:
    excess = seen(model, FILTER, noise).excess
    assert (excess.mean(dim=1) / noise**2 - 1).abs().max() < 0.5


@given(st.floats(1.0, 100.0), st.integers(0, 100))
@torch.no_grad()
def test_evidence_shrinks_with_the_square_of_the_noise(times: float, seed: int) -> None:
    torch.manual_seed(seed)
    model = simple_model(n_situations=3)  # with Gaussian noise
    adapter = EmbeddingAdapter(model, FILTER, seed=0)
    transition = [values[:, 0] for values in random_transitions(model, 2, 1)]
    belief = adapter.initial(2)
    quiet = adapter.judge(belief, *transition).log_p
    noisy = adapter.judge(replace(belief, excess=belief.excess * times**2), *transition).log_p
    torch.testing.assert_close((noisy - noisy[:, :1]) * times**2, quiet - quiet[:, :1], rtol=1e-2, atol=1e-2 * times**2)


@torch.no_grad()
def test_window_takes_the_noise_that_was_fitted(model: Dynamics) -> None:
    belief = seen(model, replace(FILTER, evidence=Window(10)), noise=4.0)
    assert (belief.excess == 1.0).all()


@torch.no_grad()
def test_fault_is_named_behind_an_error_that_lasts(model: Dynamics) -> None:
    belief = seen(model, FILTER, noise=1.0, steps=400, lasting=10.0)
    assert (belief.posterior.argmax(dim=1) == 1).all()
    assert (belief.excess.mean(dim=1) < 3.0).all()  # of 100, the square of what lasts


@given(st.integers(0, 1000), st.integers(3, 100))
@torch.no_grad()
def test_robot_at_rest_does_not_become_sure(seed: int, steps: int) -> None:
    torch.manual_seed(seed)
    model = simple_model(n_situations=3)
    adapter = EmbeddingAdapter(model, FILTER, seed=0)
    belief, moved = adapter.initial(1), torch.ones(1, dtype=torch.bool)
    transition = [values[:, 0] for values in random_transitions(model, 1, 1)]
    memory = Memory.empty(1, 200, model.obs_dim, model.action_dim, 4, torch.device("cpu"), 10)
    sure = [float(belief.posterior.max())]
    for _ in range(steps):
        evidence = adapter.judge(belief, *transition)
        memory = memory.add(*transition, evidence.log_p, evidence.own_log_p, moved)
        belief = adapter.infer(memory, belief, evidence, moved)
        sure.append(float(belief.posterior.max()))
    assert sure[-1] <= max(sure[:2]) + 1e-5  # what repeats itself is said once


@given(st.floats(-1e3, 1e3), st.integers(0, 1000))
def test_error_that_lasts_is_its_own_mean(value: float, n: int) -> None:
    lasting = torch.full((1, 1, 2, 3), value)
    torch.testing.assert_close(updated_bias(lasting, lasting, torch.tensor([float(n)])), lasting)


@torch.no_grad()
def test_window_takes_errors_as_they_are(model: Dynamics) -> None:
    assert not seen(model, replace(FILTER, evidence=Window(10)), noise=4.0).bias.any()


@given(st.floats(0.0, 1e6), st.integers(0, 10_000))
def test_excess_that_equals_what_is_seen_stays(value: float, n: int) -> None:
    excess = torch.full((2, 3), value)
    torch.testing.assert_close(updated_excess(excess, excess, torch.full((2,), float(n))), excess)


@given(st.integers(0, 1000))
def test_one_strange_moment_moves_it_little(n: int) -> None:
    moved = updated_excess(torch.ones(1, 1), torch.full((1, 1), 2.0), torch.tensor([float(n)]))
    assert 1.0 < float(moved) < 1.11


# --- in words ---------------------------------------------------------------------------------------------


def test_diagnosis_says_what_is_wrong_or_that_nothing_known_is() -> None:
    posterior = {"intact": 0.1, "joint 3 dead": 0.9}
    assert str(Diagnosis.of(posterior, 1.2, 40)) == "Most likely joint 3 dead (90%)."
    assert str(Diagnosis.of(posterior, 1.0, 0)) == "Nothing has been seen of the robot yet."
    strange = Diagnosis.of(posterior, 8.34, 40)
    assert not strange.is_known
    assert str(strange).startswith("Unlike anything that was trained: errors are 8.3 times")
    assert "joint 3 dead" in str(strange)


def test_agent_diagnoses_each_of_its_robots(quick_agent: FAMLE, transitions: Any) -> None:
    assert not quick_agent.diagnose().steps
    situations = [0, 4]
    for i in range(25):
        obs, action, next_obs = (getattr(transitions, name)[situations, i] for name in ("obs", "action", "next_obs"))
        quick_agent.observe(obs, action * quick_agent.action_space.high, next_obs)
    found = [quick_agent.diagnose(robot=robot) for robot in range(2)]
    assert [one.situation for one in found] == [quick_agent.situations[i] for i in situations]
    assert all(one.steps == 25 and one.is_known for one in found)
    with pytest.raises(IndexError, match="robots 0 to 1"):
        quick_agent.diagnose(robot=2)
