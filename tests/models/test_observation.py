from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 (torch's own custom)

from famle_agent import FAMLE
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.observation import DIMS, ObservationLayout
from famle_agent.models.reward import LearnedReward
from tests.helpers import layouts, models, random_h, simple_model

seeds = st.integers(0, 1000)
lengths, turns = st.floats(-100.0, 100.0), st.floats(-7.0, 7.0)
EXACT: dict[str, Any] = {"rtol": 1e-9, "atol": 1e-9}


def observations(layout: ObservationLayout, n: int, seed: int) -> Tensor:
    """Random ones, (n, obs_dim), in which quaternions and headings have length 1."""
    obs = torch.randn(n, layout.obs_dim, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    for dims in (layout.quaternion_dims, layout.pose_dims[2:]):
        if len(dims) > 1:
            obs[:, dims] = F.normalize(obs[:, dims], dim=-1)
    return obs


def moved(layout: ObservationLayout, obs: Tensor, way: Sequence[float], turn: float) -> Tensor:
    """What the same robots see elsewhere on the floor, turned about the origin and shifted."""
    if not layout.pose_dims:
        return obs
    obs, (x, y, *heading) = obs.clone(), layout.pose_dims
    (c, s), before = (math.cos(turn), math.sin(turn)), obs.clone()
    obs[..., x] = c * before[..., x] - s * before[..., y] + way[0]
    obs[..., y] = s * before[..., x] + c * before[..., y] + way[1]
    if len(heading) == 1:
        obs[..., heading[0]] += turn
    else:
        sine, cosine = before[..., heading[0]], before[..., heading[1]]
        obs[..., heading[0]], obs[..., heading[1]] = sine * c + cosine * s, cosine * c - sine * s
    return obs


def comparable(layout: ObservationLayout, obs: Tensor) -> Tensor:
    """The same for the same state: angles on the circle, and of q and -q the products."""
    plain = ObservationLayout(
        layout.obs_dim,
        (*layout.angle_dims, *(layout.pose_dims[2:] if len(layout.pose_dims) == 3 else ())),
        layout.quaternion_dims,
    )
    return plain.features(obs)


# --- What a model sees ---


def test_features_are_the_plain_numbers_then_angles_and_products() -> None:
    layout = ObservationLayout(9, angle_dims=(7,), quaternion_dims=(3, 4, 5, 6), pose_dims=(2, 0, 8))
    obs = torch.tensor([11.0, 0.3, 12.0, 0.1, 0.2, 0.3, 0.4, math.pi / 2, 13.0])
    products = [0.01, 0.02, 0.03, 0.04, 0.04, 0.06, 0.08, 0.09, 0.12, 0.16]
    torch.testing.assert_close(layout.features(obs), torch.tensor([0.3, 1.0, 0.0, *products]), atol=1e-6, rtol=0)


@given(layouts(), seeds)
def test_number_of_features_is_known_beforehand(layout: ObservationLayout, seed: int) -> None:
    assert layout.features(observations(layout, 3, seed)).shape == (3, layout.n_features)


@given(layouts(), seeds, st.tuples(lengths, lengths), turns)
def test_robot_looks_the_same_to_a_model_wherever_it_stands(
    layout: ObservationLayout, seed: int, way: tuple[float, float], turn: float
) -> None:
    obs = observations(layout, 4, seed)
    torch.testing.assert_close(layout.features(moved(layout, obs, way, turn)), layout.features(obs))


# --- What a model predicts ---


@given(layouts(), seeds, st.tuples(lengths, lengths), turns)
def test_change_is_the_same_wherever_the_robot_stands(
    layout: ObservationLayout, seed: int, way: tuple[float, float], turn: float
) -> None:
    obs, next_obs = observations(layout, 4, seed), observations(layout, 4, seed + 1)
    here, there = (
        layout.change(*(moved(layout, each, *at) for each in (obs, next_obs))) for at in (((0, 0), 0), (way, turn))
    )
    torch.testing.assert_close(there, here)


@pytest.mark.parametrize("heading", [0.0, 0.5, math.pi / 2, -2.0])
@pytest.mark.parametrize("as_angle", [False, True])
def test_change_of_place_is_ahead_and_to_the_left_of_the_robot(heading: float, as_angle: bool) -> None:
    sine, cosine = math.sin(heading), math.cos(heading)
    facing = [heading] if as_angle else [sine, cosine]
    layout = ObservationLayout(2 + len(facing), pose_dims=(0, 1, 2, 3)[: 2 + len(facing)])
    obs = torch.tensor([5.0, -3.0, *facing])
    next_obs = torch.tensor([5.0 + 0.3 * cosine - 0.1 * sine, -3.0 + 0.3 * sine + 0.1 * cosine, *facing])
    expected = torch.tensor([0.3, 0.1, *[0.0] * len(facing)])
    torch.testing.assert_close(layout.change(obs, next_obs), expected, atol=1e-6, rtol=0)


@given(turns, st.floats(-3.0, 3.0))
def test_change_of_heading_is_the_angle_turned_or_its_sine_and_cosine(heading: float, turn: float) -> None:
    angle = ObservationLayout(3, pose_dims=(0, 1, 2))
    circle = ObservationLayout(4, pose_dims=(0, 1, 2, 3))
    before, after = (math.remainder(value, 2 * math.pi) for value in (heading, heading + turn))
    rows = [torch.tensor([0.0, 0.0, value], dtype=torch.float64) for value in (before, after)]
    torch.testing.assert_close(angle.change(*rows)[2].item(), turn, **EXACT)
    rows = [torch.tensor([0.0, 0.0, math.sin(v), math.cos(v)], dtype=torch.float64) for v in (before, after)]
    turned = circle.change(*rows)[2:] + torch.tensor([0.0, 1.0])
    torch.testing.assert_close(turned.tolist(), [math.sin(turn), math.cos(turn)], **EXACT)


@given(layouts(), seeds)
def test_what_has_changed_leads_to_the_next_observation(layout: ObservationLayout, seed: int) -> None:
    obs, next_obs = observations(layout, 4, seed), observations(layout, 4, seed + 1)
    for gradient in (False, True):
        change = layout.change(obs, next_obs).requires_grad_(gradient)
        reached = layout.advance(obs, change)
        assert reached.requires_grad is gradient
        torch.testing.assert_close(comparable(layout, reached), comparable(layout, next_obs), **EXACT)


@given(layouts(), seeds)
def test_observations_are_not_touched(layout: ObservationLayout, seed: int) -> None:
    obs, next_obs = observations(layout, 4, seed), observations(layout, 4, seed + 1)
    layout.advance(obs, layout.change(obs, next_obs))
    layout.features(obs)
    assert torch.equal(obs, observations(layout, 4, seed))
    assert torch.equal(next_obs, observations(layout, 4, seed + 1))


def test_heading_that_is_predicted_has_length_one() -> None:
    layout = ObservationLayout(4, pose_dims=(0, 1, 2, 3))
    reached = layout.advance(observations(layout, 50, 0), torch.randn(50, 4, dtype=torch.float64))
    torch.testing.assert_close(reached[:, 2:].norm(dim=-1), torch.ones(50, dtype=torch.float64))


# --- Models and rewards ---


@given(models(), seeds, st.tuples(lengths, lengths), turns)
def test_model_predicts_the_same_motion_wherever_the_robot_stands(
    model: Dynamics, seed: int, way: tuple[float, float], turn: float
) -> None:
    model, layout, h = model.double(), model.layout, random_h(model, 2).double()
    obs = observations(layout, 6, seed).reshape(2, 3, -1)
    action = torch.rand(2, 3, model.action_dim, dtype=torch.float64)
    here, there = (model.predict(each, action, h).detach() for each in (obs, moved(layout, obs, way, turn)))
    torch.testing.assert_close(there, moved(layout, here, way, turn), rtol=1e-7, atol=1e-7)


def test_model_that_sees_the_actions_alone_is_normalised_without_a_warning() -> None:
    model = simple_model(obs_dim=4, pose_dims=(0, 1, 2, 3))
    warned_always = torch.is_warn_always_enabled()
    torch.set_warn_always(True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            model.fit_normalisation(torch.randn(10, 4), torch.randn(10, model.action_dim), torch.randn(10, 4))
    finally:
        torch.set_warn_always(warned_always)


def test_learned_reward_sees_where_the_robot_is() -> None:
    """A goal has a place, though the dynamics have none."""
    torch.manual_seed(0)
    layout = ObservationLayout(4, pose_dims=(0, 1, 2, 3))
    reward = LearnedReward(layout, action_dim=1, width=32)
    obs, next_obs = (observations(layout, 1000, seed).float() for seed in (0, 1))
    action, true = torch.zeros(1000, 1), -next_obs[:, :2].norm(dim=-1)
    reward.fit(obs, action, next_obs, true, torch.Generator().manual_seed(0), steps=300)
    error = reward(obs, action, next_obs) - true
    assert error.std() < 0.3 * true.std()


# --- Which dimensions they are ---


@pytest.mark.parametrize(
    ("robot", "expected"),
    [
        ("FamleReacher-v0", ((0, 1, 2, 3, 4), (), ())),
        ("FamleAnt-v0", ((), (1, 2, 3, 4), ())),
        ("FamleQuadruped-v0", ((), (), (0, 1, 2, 3))),
        ("FamleA1-v0", ((), (), (0, 1, 2, 3))),
        ("FamleMinitaur-v0", ((3, 4), (), (0, 1, 5))),
    ],
)
def test_dimensions_are_those_of_the_environment_or_of_the_user(robot: str, expected: tuple[Any, ...]) -> None:
    agent = FAMLE(robot, device="cpu", pretrained=False)
    assert agent.dims == dict(zip(DIMS, expected, strict=True))
    own = {"angle_dims": (), "quaternion_dims": (), "pose_dims": (3, 1, 0)}
    assert FAMLE(agent.get_env(), device="cpu", pretrained=False, **own).dims == own
    agent.get_env().close()


@pytest.mark.parametrize("robot", ["FamleQuadruped-v0", "FamleMinitaur-v0"])
def test_model_of_the_paper_knows_nothing_of_poses(robot: str) -> None:
    agent = FAMLE(robot, "paper", device="cpu")
    assert agent.dims["pose_dims"] == ()
    agent.get_env().close()


def test_yaw_is_an_angle_to_the_model_of_the_paper_too() -> None:
    agent = FAMLE("FamleMinitaur-v0", "paper", device="cpu")
    agent.get_env().close()
    obs, next_obs = (torch.tensor([0.0, 0.0, 0.2, 0.0, 0.0, yaw]) for yaw in (math.pi - 0.05, -math.pi + 0.05))
    assert agent.policy.builder.robot.layout.change(obs, next_obs)[5].item() == pytest.approx(0.1, abs=1e-5)


@pytest.mark.parametrize(
    ("dims", "message"),
    [
        ({"pose_dims": (0, 1)}, "pose_dims"),
        ({"pose_dims": (0, 1, 2, 3, 4)}, "pose_dims"),
        ({"quaternion_dims": (0, 1, 2)}, "quaternion_dims"),
        ({"pose_dims": (0, 1, 1)}, "twice"),
        ({"pose_dims": (0, 1, 2), "angle_dims": (2,)}, "twice"),
        ({"pose_dims": (0, 1, 6)}, "has not"),
        ({"pose_dims": (-1, 1, 2)}, "has not"),
    ],
)
def test_dimensions_that_make_no_sense_are_refused(dims: dict[str, tuple[int, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ObservationLayout(6, **dims)
