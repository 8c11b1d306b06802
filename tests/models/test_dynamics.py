from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F  # noqa: N812 (torch's own custom)

from famle_agent.models.dynamics import Dynamics, expand
from tests.helpers import models, random_h, random_theta, random_transitions, rows_of, simple_model

# --- one code path for one and for many -----------------------------------------------------------------


@given(models(), st.integers(1, 4), st.integers(1, 6))
def test_networks_in_a_batch_equal_each_alone(model: Dynamics, size: int, n: int) -> None:
    theta, h, P = random_theta(model, size), random_h(model, size), model.members
    obs, action, next_obs = random_transitions(model, size * P, n)
    weight = (torch.rand(size * P, n) > 0.3).float()
    data = model.encode(obs, action, next_obs, weight)
    loss, density = model.loss(theta, h, data), model.log_likelihood(theta, h, data)
    predicted = model.simulator(theta, h)(obs, action)
    assert loss.shape == (size * P,)
    assert density.shape == (size * P, n)
    for i in range(size):
        rows = slice(i * P, (i + 1) * P)  # all members of one robot: each has a noise of its own
        alone = model.encode(obs[rows], action[rows], next_obs[rows], weight[rows])
        one = rows_of(theta, rows)
        torch.testing.assert_close(model.loss(one, h[rows], alone), loss[rows])
        torch.testing.assert_close(model.log_likelihood(one, h[rows], alone), density[rows], rtol=1e-5, atol=1e-4)
        torch.testing.assert_close(model.simulator(one, h[rows])(obs[rows], action[rows]), predicted[rows])


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("quaternion_dims", [(), (1, 2, 3, 5)])
@pytest.mark.parametrize("interaction_rank", [0, 2])
@pytest.mark.parametrize("gate_actions", [False, True])
def test_folded_network_equals_prediction_with_the_same_embedding(
    gate_actions: bool, interaction_rank: int, quaternion_dims: tuple[int, ...], members: int
) -> None:
    model = simple_model(
        obs_dim=6,
        angle_dims=(4,),
        quaternion_dims=quaternion_dims,
        gate_actions=gate_actions,
        interaction_rank=interaction_rank,
        members=members,
    ).double()
    obs, action, next_obs = (values.double() for values in random_transitions(model, 2 * members, 5))
    model.fit_normalisation(3 + 2 * obs, 0.5 + 0.1 * action, 1 + 3 * next_obs)
    data = model.encode(obs, action, next_obs)
    theta, h = {name: value.double() for name, value in random_theta(model, 2).items()}, random_h(model, 2).double()
    folded = model.forward(model.network(theta, h), data.x)
    torch.testing.assert_close(model.predict(theta, h[:, None], data.x), folded)
    torch.testing.assert_close(model.predict(theta, h[:, None].expand(-1, 5, -1), data.x), folded)
    expected = obs + folded * model.target_std + model.target_mean
    torch.testing.assert_close(model.simulator(theta, h)(obs, action), expected)
    unlike = model.forward(model.network(theta, h + 0.1), data.x)
    assert (unlike - folded).abs().amin(dim=(1, 2)).max() > 0  # the embedding matters


@given(models(), st.integers(1, 3), st.integers(2, 6))
def test_each_row_may_have_an_embedding_of_its_own(model: Dynamics, size: int, n: int) -> None:
    theta, x = random_theta(model, size), torch.randn(size * model.members, n, model.n_features + model.action_dim)
    h = torch.randn(len(x), n, model.embeddings.shape[-1])
    together = model.predict(theta, h, x)
    for row in range(n):
        alone = model.predict(theta, h[:, row : row + 1], x[:, row : row + 1])
        torch.testing.assert_close(together[:, row : row + 1], alone, rtol=1e-4, atol=1e-4)


@given(models(), st.integers(1, 3))
def test_rollouts_of_candidates_are_independent(model: Dynamics, size: int) -> None:
    # In double precision: in single, batches of another size round otherwise by more than the comparison allows.
    theta = {name: value.double() for name, value in random_theta(model, size).items()}
    obs, action = (values.double() for values in random_transitions(model, size * model.members, 5)[:2])
    simulator = model.double().simulator(theta, random_h(model, size).double())
    torch.testing.assert_close(simulator(obs, action)[:, 2:3], simulator(obs[:, 2:3], action[:, 2:3]))


# --- members of an ensemble -------------------------------------------------------------------------------


def test_expand_shows_the_same_parameters_often() -> None:
    theta = simple_model().parameters_by_name()
    for name, value in expand(theta, 3).items():
        assert value.shape == (3, *theta[name].shape[1:])
        assert value.data_ptr() == theta[name].data_ptr()
        assert not value.requires_grad


@given(models(), st.integers(1, 4))
def test_expand_gives_each_robot_all_members(model: Dynamics, size: int) -> None:
    theta, P = model.parameters_by_name(), model.members
    for name, value in expand(theta, size).items():
        assert value.shape == (size * P, *theta[name].shape[1:])
        for robot in range(size):
            assert torch.equal(value[robot * P : (robot + 1) * P], theta[name])


def test_members_are_independent_networks() -> None:
    model = simple_model(members=3, interaction_rank=2)
    theta, h = model.parameters_by_name(), model.embeddings_of(torch.tensor([1]))
    obs, action, next_obs = random_transitions(model, 1, 6)
    data = model.encode(*(values.expand(3, -1, -1) for values in (obs, action, next_obs)))
    before = model.loss(theta, h, data)
    assert len(set(before.tolist())) == 3  # they begin differently
    for name in theta:
        changed = {key: value.clone() for key, value in theta.items()}
        changed[name][1] += 0.1
        after = model.loss(changed, h, data)
        assert torch.equal(after[[0, 2]], before[[0, 2]])
        assert after[1] != before[1]


@given(models(), st.data())
def test_part_of_an_ensemble_is_some_of_its_members(model: Dynamics, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, model.members))
    first = data.draw(st.integers(0, model.members - count))
    part, chosen = model.with_members(count, first), slice(first, first + count)
    assert part.members == count
    h, batch = torch.randn(count, model.embeddings.shape[-1]), model.encode(*random_transitions(model, count, 4))
    whole = rows_of(model.parameters_by_name(), chosen)
    torch.testing.assert_close(part.loss(part.parameters_by_name(), h, batch), model.loss(whole, h, batch))
    assert torch.equal(part.embeddings, model.embeddings[chosen])
    assert torch.equal(part.noise_std, model.noise_std[chosen])
    with torch.no_grad():
        part.embeddings.add_(1.0)
    assert not torch.equal(part.embeddings, model.embeddings[chosen])
    for wrong, start in ((0, 0), (model.members + 1, 0), (1, model.members), (1, -1), (model.members, 1)):
        with pytest.raises(ValueError, match=f"1 to {model.members} members to give, not {wrong} from {start} on"):
            model.with_members(wrong, start)


@given(models(), st.lists(st.integers(0, 3), min_size=1, max_size=6))
def test_single_embedding_is_that_of_all_situations(model: Dynamics, situations: list[int]) -> None:
    c = torch.tensor(situations) % max(model.n_situations, 4 * (model.n_situations == 1))
    index = model.embedding_index(c)
    assert index.tolist() == (c.tolist() if model.n_situations > 1 else [0] * len(c))
    expected = model.embeddings.detach()[:, index].transpose(0, 1).flatten(0, 1)
    assert torch.equal(model.embeddings_of(c), expected)


def test_embeddings_of_situations_are_ordered_by_robot() -> None:
    model = simple_model(members=2)
    h, c = model.embeddings_of(torch.tensor([3, 0, 3])), (3, 0, 3)
    assert h.shape == (6, model.embeddings.shape[-1])
    for robot in range(3):
        for member in range(2):
            assert torch.equal(h[2 * robot + member], model.embeddings[member, c[robot]])
    assert not h.requires_grad


# --- the model is the paper's -----------------------------------------------------------------------------


def test_embedding_is_concatenated_to_the_input() -> None:
    model = simple_model(gate_actions=False, embedding_dim=5, hidden=(7,))
    theta, h = random_theta(model, 2), torch.randn(2, 5)
    x = torch.randn(2, 6, model.n_features + model.action_dim)
    first = torch.cat([theta["weight_0"], theta["embedding"]], dim=1)
    inputs = torch.cat([x, h[:, None].expand(-1, 6, -1)], dim=-1)
    hidden = F.silu(inputs @ first + theta["bias_0"][:, None])
    expected = hidden @ theta["weight_1"] + theta["bias_1"][:, None]
    torch.testing.assert_close(model.forward(model.network(theta, h), x), expected)


def test_paper_network_has_no_gate() -> None:
    assert "gate" not in simple_model(gate_actions=False).theta
    assert simple_model(gate_actions=True).theta["gate"].shape == (1, 5, 2)
    assert not [name for name in simple_model().theta if "interaction" in name]


@pytest.mark.parametrize("gain", [-1.0, 0.0, 0.4])
def test_gate_expresses_the_gain_of_each_motor(gain: float) -> None:
    model = simple_model(embedding_dim=2)
    theta = model.parameters_by_name()
    theta["embedding"] = torch.zeros_like(theta["embedding"])  # h acts through the gate alone
    theta["gate"] = torch.eye(2)[None]
    obs, action, _ = random_transitions(model, 1, 6)
    broken = model.simulator(theta, torch.tensor([[0.0, gain - 1.0]]))(obs, action)
    intact = model.simulator(theta, torch.zeros(1, 2))(obs, action * torch.tensor([1.0, gain]))
    torch.testing.assert_close(broken, intact)


@pytest.mark.parametrize(("gate_actions", "interaction_rank", "acts"), [(True, 0, 1), (False, 3, 1), (True, 3, 0)])
def test_faults_add_up_in_the_first_layer(gate_actions: bool, interaction_rank: int, acts: int) -> None:
    """h_1 + h_2 does there what h_1 and h_2 do, each by itself; where both are linear, for observations at least."""
    model = simple_model(gate_actions=gate_actions, interaction_rank=interaction_rank).double()
    theta = {name: value.double() for name, value in random_theta(model, 1).items()}
    intact, one, other = torch.randn(3, 1, model.embeddings.shape[-1], dtype=torch.float64)
    x = torch.randn(1, 7, model.n_features + model.action_dim, dtype=torch.float64)
    x[..., model.n_features :] *= acts

    def effect(h: torch.Tensor) -> torch.Tensor:
        (weight, bias), (intact_weight, intact_bias) = (model.network(theta, each)[0] for each in (h, intact))
        return x @ (weight - intact_weight) + bias - intact_bias

    torch.testing.assert_close(effect(one + other - intact), effect(one) + effect(other))
    assert effect(one).std(dim=1).min() > 0.1  # more than a bias


def test_interaction_is_bilinear() -> None:
    model = simple_model(interaction_rank=2, gate_actions=False)
    theta, h = random_theta(model, 2), random_h(model, 2)
    x = torch.randn(2, 6, model.n_features + model.action_dim)
    U, V, C = (theta[f"interaction_{name}"] for name in ("input", "situation", "output"))
    z = x @ theta["weight_0"] + theta["bias_0"][:, None] + h[:, None] @ theta["embedding"]
    z = z + ((x @ U) * (h[:, None] @ V)) @ C
    hidden = F.silu(F.silu(z) @ theta["weight_1"] + theta["bias_1"][:, None])
    expected = hidden @ theta["weight_2"] + theta["bias_2"][:, None]
    torch.testing.assert_close(model.predict(theta, h[:, None], x), expected)


# --- angles -----------------------------------------------------------------------------------------------


@given(
    st.floats(-math.pi, math.pi),
    st.floats(-3.0, 3.0),
    st.integers(-2, 2),
    st.integers(-2, 2),
)
def test_full_turns_of_an_angle_change_nothing(angle: float, change: float, turns: int, next_turns: int) -> None:
    model = simple_model(obs_dim=2, angle_dims=[1]).double()
    theta, h = model.parameters_by_name(), model.embeddings[:, 0]
    obs, action = torch.tensor([[[0.3, angle]]], dtype=torch.float64), torch.rand(1, 1, 2, dtype=torch.float64)
    next_obs = torch.tensor([[[0.1, angle + change]]], dtype=torch.float64)
    turn = torch.tensor([0.0, 2 * math.pi], dtype=torch.float64)
    data = model.encode(obs, action, next_obs)
    turned = model.encode(obs + turns * turn, action, next_obs + next_turns * turn)
    torch.testing.assert_close(model.loss(theta, h, turned), model.loss(theta, h, data))
    torch.testing.assert_close(model.log_likelihood(theta, h, turned), model.log_likelihood(theta, h, data))
    simulator = model.simulator(theta, h)
    one, other = simulator(obs, action) - next_obs, simulator(obs + turns * turn, action) - next_obs - turns * turn
    torch.testing.assert_close(one, other)


def test_step_across_the_jump_is_as_small_as_any_other() -> None:
    model = simple_model(obs_dim=1, angle_dims=[0])
    obs, next_obs = (
        torch.tensor([[math.pi - 0.05], [0.0], [-math.pi + 0.05]]),
        torch.tensor([[-math.pi + 0.05], [0.1], [math.pi - 0.05]]),
    )
    torch.testing.assert_close(model.targets(obs, next_obs), torch.tensor([[0.1], [0.1], [-0.1]]), atol=1e-5, rtol=0)
    assert obs.tolist()[0][0] == pytest.approx(math.pi - 0.05)  # the data are not touched


def test_features_are_the_other_dimensions_and_sine_and_cosine() -> None:
    model = simple_model(obs_dim=3, angle_dims=[1])
    features = model.features(torch.tensor([[2.0, math.pi / 2, 5.0]]))
    torch.testing.assert_close(features, torch.tensor([[2.0, 5.0, 1.0, 0.0]]), atol=1e-6, rtol=0)


# --- quaternions ------------------------------------------------------------------------------------------


def quaternions(*shape: int) -> torch.Tensor:
    return F.normalize(torch.randn(*shape, 4, dtype=torch.float64), dim=-1)


def posed(others: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Observations of five dimensions: one number, then a quaternion."""
    return torch.cat([others, q], dim=-1)


@given(st.integers(0, 1000), st.sampled_from([-1.0, 1.0]), st.sampled_from([-1.0, 1.0]))
def test_orientation_is_the_same_for_q_and_minus_q(seed: int, sign: float, next_sign: float) -> None:
    model = simple_model(obs_dim=5, quaternion_dims=(1, 2, 3, 4)).double()
    torch.manual_seed(seed)
    q, q_next, other = quaternions(2, 3), quaternions(2, 3), torch.randn(2, 3, 1, dtype=torch.float64)
    obs, next_obs = posed(other, q), posed(other + 0.2, q_next)
    turned, next_turned = posed(other, sign * q), posed(other + 0.2, next_sign * q_next)
    torch.testing.assert_close(model.features(turned), model.features(obs))
    target, expected = model.targets(turned, next_turned), model.targets(obs, next_obs)
    torch.testing.assert_close(target[..., :1], expected[..., :1])
    torch.testing.assert_close(target[..., 1:], sign * expected[..., 1:])
    reached = turned + target
    torch.testing.assert_close(model.features(reached), model.features(next_obs))
    assert (target[..., 1:].norm(dim=-1) <= math.sqrt(2) + 1e-9).all()  # the short way round


def test_quaternion_enters_as_the_products_of_its_parts() -> None:
    model = simple_model(obs_dim=5, quaternion_dims=(1, 2, 3, 4))
    features = model.features(torch.tensor([[7.0, 0.1, 0.2, 0.3, 0.4]]))
    products = [0.01, 0.02, 0.03, 0.04, 0.04, 0.06, 0.08, 0.09, 0.12, 0.16]
    torch.testing.assert_close(features, torch.tensor([[7.0, *products]]))
    assert model.n_features == 11


def test_rotation_is_linear_in_the_products() -> None:
    """A turn of the sensor maps the features of all orientations by one matrix."""
    model = simple_model(obs_dim=4, quaternion_dims=(0, 1, 2, 3)).double()
    torch.manual_seed(0)
    q, c, s = quaternions(40), math.cos(0.3), math.sin(0.3)
    x, y, z, w = q.unbind(dim=-1)
    turned = torch.stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z], dim=-1)
    solution = torch.linalg.lstsq(model.features(q[:20]), model.features(turned[:20])).solution
    torch.testing.assert_close(model.features(q[20:]) @ solution, model.features(turned[20:]))


def test_observations_are_not_touched() -> None:
    model = simple_model(obs_dim=5, quaternion_dims=(1, 2, 3, 4), angle_dims=(0,))
    obs, _, next_obs = random_transitions(model, 3, 4)
    before, next_before = obs.clone(), -next_obs
    model.targets(obs, -next_obs)
    assert torch.equal(obs, before)
    assert torch.equal(-next_obs, next_before)


# --- initial weights --------------------------------------------------------------------------------------


def test_initial_weights_may_be_those_of_pytorch_s_own_layers() -> None:
    sizes = {"obs_dim": 20, "action_dim": 5, "embedding_dim": 8, "hidden": (70, 50), "members": 30}
    torch.manual_seed(0)
    model = Dynamics(n_situations=3, gate_actions=False, initial_weights="uniform", **sizes)
    layers = [torch.nn.Linear(33, 70), torch.nn.Linear(70, 50), torch.nn.Linear(50, 20)]
    for name, layer in zip(("weight_0", "weight_1", "weight_2"), layers, strict=True):
        theirs = layer.weight.std().item()
        assert model.theta[name].std().item() == pytest.approx(theirs, rel=0.1)
        assert model.theta[name].abs().max() <= layer.in_features**-0.5
        assert 0 < model.theta[name.replace("weight", "bias")].abs().max() <= layer.in_features**-0.5
    assert model.theta["embedding"].abs().max() <= 33**-0.5
    assert model.embeddings.std().item() == pytest.approx(1.0, rel=0.1)


# --- normalisation ----------------------------------------------------------------------------------------


def test_normalised_data_have_mean_zero_and_deviation_one() -> None:
    model = simple_model()
    obs, action, next_obs = random_transitions(model, 4, 500)
    obs, next_obs = obs * torch.tensor([1.0, 10.0, 0.01]) + 7, next_obs * torch.tensor([1.0, 10.0, 0.01]) + 7
    model.fit_normalisation(obs, action, next_obs)
    data = model.encode(obs, action, next_obs)
    for values in (data.x[..., :3], data.y):
        torch.testing.assert_close(values.mean(dim=(0, 1)), torch.zeros(3), atol=1e-3, rtol=0)
        torch.testing.assert_close(values.flatten(0, 1).std(dim=0), torch.ones(3), atol=1e-3, rtol=0)
    assert torch.equal(data.x[..., 3:], action)
    assert torch.equal(data.weight, torch.ones(4, 500))


@given(st.floats(-1e4, 1e4, width=32))
def test_dimension_that_never_varies_is_not_blown_up(constant: float) -> None:
    model = simple_model()
    obs, action, next_obs = random_transitions(model, 4, 50)
    obs[..., 1] = next_obs[..., 1] = constant
    model.fit_normalisation(obs, action, next_obs)
    data = model.encode(obs + torch.tensor([0.0, 1.0, 0.0]), action, next_obs)
    assert data.x[..., 1].abs().max() < 2
    assert data.y[..., 1].abs().max() < 2
