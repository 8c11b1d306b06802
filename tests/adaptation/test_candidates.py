from __future__ import annotations

from itertools import combinations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from famle_agent.adaptation.belief import prior
from famle_agent.adaptation.candidates import Candidates
from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from tests.helpers import adapted, log_likelihood, memory_of, models, random_transitions, simple_model

numbers_of_situations = st.integers(1, 6)
NAMES = ("intact", "a", "b", "c", "d", "e")


def expected_pairs(n: int, compose: bool) -> list[tuple[int, int]]:
    """All situations alone, then all pairs of two that are not the first one."""
    return [(i, 0) for i in range(n)] + (list(combinations(range(1, n), 2)) if compose else [])


# --- what they are ----------------------------------------------------------------------------------------


@given(numbers_of_situations, st.booleans(), st.integers(1, 3))
def test_candidates_are_situations_and_sums_of_two(n: int, compose: bool, members: int) -> None:
    model = simple_model(n_situations=n, members=members)
    candidates, pairs, H = Candidates.of(model, compose), expected_pairs(n, compose), model.embeddings
    assert [tuple(pair) for pair in candidates.pairs.tolist()] == pairs
    assert candidates.h.shape == (1, members, len(pairs), model.embeddings.shape[-1])
    assert not candidates.h.requires_grad
    assert torch.allclose(candidates.h[0, :, :n], H, atol=1e-6)
    together = torch.einsum("cn,pne->pce", candidates.shares, H)
    torch.testing.assert_close(candidates.h[0], together)
    for number, (i, j) in enumerate(pairs):
        torch.testing.assert_close(candidates.h[0, :, number], (H[:, i] + H[:, j] - H[:, 0]).detach())


@given(numbers_of_situations, st.booleans())
def test_names_say_what_is_wrong(n: int, compose: bool) -> None:
    names = Candidates.of(simple_model(n_situations=n), compose).names(NAMES[:n])
    assert names[:n] == list(NAMES[:n])
    assert names[n:] == ([f"{x} + {y}" for x, y in combinations(NAMES[1:n], 2)] if compose else [])


@given(numbers_of_situations, st.booleans())
def test_before_all_data_no_robot_is_likelier_than_the_intact_one(n: int, compose: bool) -> None:
    model = simple_model(n_situations=n)
    candidates = Candidates.of(model, compose)
    posterior = prior(model, candidates, robots=2).posterior
    torch.testing.assert_close(posterior.sum(dim=1), torch.ones(2))
    if not compose or n < 3:  # the paper's
        torch.testing.assert_close(posterior, torch.full_like(posterior, 1 / posterior.shape[1]))
        return
    intact, single, both = posterior[:, 0], posterior[:, 1:n], posterior[:, n:]
    torch.testing.assert_close(intact, single.sum(dim=1))
    torch.testing.assert_close(intact, 2 * both.sum(dim=1))
    assert len(single.unique()) == len(both.unique()) == 1


@given(numbers_of_situations, st.booleans(), st.integers(0, 100))
def test_marginal_counts_each_situation_where_it_takes_part(n: int, compose: bool, seed: int) -> None:
    candidates = Candidates.of(simple_model(n_situations=n), compose)
    pairs = expected_pairs(n, compose)
    logits = 2 * torch.randn(3, len(pairs), generator=torch.Generator().manual_seed(seed))
    posterior = torch.softmax(logits, dim=1)
    before = posterior.clone()
    marginal = candidates.marginal(posterior)
    assert torch.equal(posterior, before)
    for situation in range(n):
        takes_part = [i == situation or (j == situation and j > 0) for i, j in pairs]
        torch.testing.assert_close(marginal[:, situation], posterior[:, takes_part].sum(dim=1))


# --- how likely they are ----------------------------------------------------------------------------------


@given(models(), st.booleans(), st.integers(1, 3), st.integers(1, 4))
def test_likelihood_equals_that_of_each_candidate_alone(model: Dynamics, compose: bool, robots: int, n: int) -> None:
    candidates = Candidates.of(model, compose)
    data = model.encode(*random_transitions(model, robots, n), (torch.rand(robots, n) > 0.3).float())
    together = candidates.log_likelihood(model, data)
    assert together.shape == (robots, n, len(candidates.pairs))
    assert (together[data.weight == 0] == 0).all()
    for robot in range(robots):
        row = torch.tensor([[robot]])
        alone = Batch(data.x[row[0]], data.y[row[0]], data.weight[row[0]])
        for number in range(len(candidates.pairs)):
            each = log_likelihood(model, alone, candidates.h[:, :, number])[0].detach() * alone.weight[0]
            torch.testing.assert_close(together[robot, :, number], each, rtol=1e-4, atol=1e-3)


def gains(gain: list[float], n: int = 60, seed: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """Transitions (1, n) of two motors that move two numbers, each with a gain."""
    generator = torch.Generator().manual_seed(seed)
    obs = torch.randn(1, n, 2, generator=generator)
    action = torch.rand(1, n, 2, generator=generator) * 2 - 1
    noise = 0.02 * torch.randn(1, n, 2, generator=generator)
    return obs, action, obs + torch.tensor(gain) * action + noise


SITUATIONS = {"intact": [1.0, 1.0], "left dead": [0.0, 1.0], "right dead": [1.0, 0.0], "left weak": [0.5, 1.0]}


@pytest.fixture
def two_motors() -> Dynamics:
    """A model of two members that knows the four situations and adds up faults: the gate scales each motor."""
    model = Dynamics(2, 2, n_situations=4, embedding_dim=2, hidden=(2,), members=2)
    far = 20.0  # where the hidden layer is linear
    with torch.no_grad():
        for value in model.theta.values():
            value.zero_()
        model.theta["weight_0"][:, 2:] = model.theta["weight_1"][:] = torch.eye(2)
        model.theta["bias_0"].fill_(far)
        model.theta["bias_1"].fill_(-far)
        gain = torch.tensor(list(SITUATIONS.values()))
        for member, unit in enumerate((1.0, 2.0)):  # each has embeddings of its own
            model.theta["gate"][member] = torch.eye(2) / unit
            model.embeddings[member] = unit * (gain - 1.0)
    model.noise_std.fill_(0.02)
    return model


@pytest.mark.parametrize(
    ("gain", "name"),
    [
        ([0.0, 0.0], "left dead + right dead"),
        ([0.5, 0.0], "right dead + left weak"),
        ([1.0, 1.0], "intact"),
        ([1.0, 0.0], "right dead"),
    ],
)
def test_two_faults_are_named_where_they_add_up(two_motors: Dynamics, gain: list[float], name: str) -> None:
    data = two_motors.encode(*gains(gain))
    candidates = Candidates.of(two_motors, compose=True)
    likely = candidates.log_likelihood(two_motors, data).sum(dim=1).argmax(dim=1)
    assert candidates.names(list(SITUATIONS))[likely.item()] == name


def test_data_of_two_faults_fit_neither_alone(two_motors: Dynamics) -> None:
    data = two_motors.encode(*gains([0.0, 0.0]))
    candidates = Candidates.of(two_motors, compose=True)
    log_p = candidates.log_likelihood(two_motors, data)[0].sum(dim=0)
    assert log_p[4:].max() > log_p[:4].max() + 50
    memory = memory_of(two_motors, candidates, *gains([0.0, 0.0]))
    belief = adapted(two_motors, candidates, memory, InnerLoop(0, 0.0, 0.0))
    marginal = candidates.marginal(belief.posterior)[0]
    torch.testing.assert_close(marginal, torch.tensor([0.0, 1.0, 1.0, 0.0]), atol=0.01, rtol=0)


# --- adaptation of robots in several members --------------------------------------------------------------


@pytest.mark.parametrize("optimizer", ["sgd", "adam"])
@pytest.mark.parametrize("compose", [False, True])
def test_robots_with_several_members_adapt_as_each_would_alone(
    two_motors: Dynamics, compose: bool, optimizer: str
) -> None:
    loop, candidates = InnerLoop(5, 0.01, 0.05, optimizer), Candidates.of(two_motors, compose)
    parts = [gains(gain, 20, seed=9) for gain in ([1.0, 0.0], [0.0, 0.0], [0.5, 1.0])]
    obs, action, next_obs = (torch.cat(values) for values in zip(*parts, strict=True))
    together = adapted(two_motors, candidates, memory_of(two_motors, candidates, obs, action, next_obs), loop)
    assert together.h.shape == (3, 2, 2)
    for robot in range(3):
        memory = memory_of(two_motors, candidates, *parts[robot])
        alone = adapted(two_motors, candidates, memory, loop)
        rows = slice(robot, robot + 1)
        torch.testing.assert_close(alone.h, together.h[rows], rtol=1e-3, atol=1e-4)
        torch.testing.assert_close(alone.log_posterior[0], together.log_posterior[robot], rtol=1e-4, atol=1e-2)
        for name, value in alone.theta.items():
            torch.testing.assert_close(value, together.theta[name][rows], rtol=1e-3, atol=1e-4)


def test_each_member_starts_from_its_own_embedding(two_motors: Dynamics) -> None:
    candidates = Candidates.of(two_motors, compose=True)
    start = prior(two_motors, candidates, 2)
    memory = memory_of(two_motors, candidates, *gains([0.0, 0.0]))
    selected = adapted(two_motors, candidates, memory, InnerLoop(0, 0.0, 0.0))
    for member in range(2):
        H = two_motors.embeddings[member].detach()
        for robot in range(2):
            assert torch.equal(start.h[robot, member], H[0])
        torch.testing.assert_close(selected.h[0, member], H[1] + H[2] - H[0])
        for name, value in two_motors.theta.items():
            assert torch.equal(selected.theta[name][0, member], value[member])


def test_one_member_that_diverges_leaves_the_whole_robot_where_it_started(two_motors: Dynamics) -> None:
    candidates = Candidates.of(two_motors, compose=False)
    obs, action, next_obs = (values.expand(2, -1, -1) for values in gains([1.0, 0.0]))
    wild = memory_of(
        two_motors, candidates, obs, action, obs + torch.tensor([1.0, 1e18])[:, None, None] * (next_obs - obs)
    )
    belief = adapted(two_motors, candidates, wild, InnerLoop(20, 1e-4, 1e-2))
    selected = candidates.h[0][:, belief.posterior.argmax(dim=1)]  # (P, B, embedding_dim)
    assert torch.equal(belief.h[1], selected[:, 1])
    assert not torch.equal(belief.h[0], selected[:, 0])
    assert belief.is_finite().all()


@given(st.integers(1, 12))
def test_nothing_is_likelier_than_the_intact_robot_before_anything_is_seen(n_situations: int) -> None:
    prior = Candidates.of(simple_model(n_situations=n_situations), compose=True).log_prior.exp()
    assert prior.sum() == pytest.approx(1.0)
    assert prior.argmax() == 0
    assert (prior <= prior[0]).all()
