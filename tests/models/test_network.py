"""The network, the model of one robot and one member being the easiest way to have one."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F  # noqa: N812 (torch's own custom)

from famle_agent.models.dynamics import Dynamics
from famle_agent.models.network import Theta
from tests.helpers import simple_model


def parameters(model: Dynamics, networks: int = 2) -> tuple[Theta, torch.Tensor]:
    """Random parameters and embeddings of K networks."""
    theta = {name: torch.randn(networks, *value.shape[1:]) for name, value in model.theta.items()}
    return theta, torch.randn(networks, model.embeddings.shape[-1])


# --- the model is the paper's -----------------------------------------------------------------------------


def test_embedding_is_concatenated_to_the_input() -> None:
    model = simple_model(gate_actions=False, embedding_dim=5, hidden=(7,))
    theta, h = parameters(model)
    x = torch.randn(2, 6, model.n_features + model.action_dim)
    first = torch.cat([theta["weight_0"], theta["embedding"]], dim=1)
    inputs = torch.cat([x, h[:, None].expand(-1, 6, -1)], dim=-1)
    hidden = F.silu(inputs @ first + theta["bias_0"][:, None])
    expected = hidden @ theta["weight_1"] + theta["bias_1"][:, None]
    torch.testing.assert_close(model.network(theta, x, h[:, None]), expected)


def test_paper_network_has_no_gate() -> None:
    assert "gate" not in simple_model(gate_actions=False).theta
    assert simple_model(gate_actions=True).theta["gate"].shape == (1, 5, 2)
    assert not [name for name in simple_model().theta if "interaction" in name]


@pytest.mark.parametrize("gain", [-1.0, 0.0, 0.4])
def test_gate_expresses_the_gain_of_each_motor(gain: float) -> None:
    model = simple_model(embedding_dim=2)
    theta, _ = parameters(model, 1)
    theta["embedding"] = torch.zeros_like(theta["embedding"])  # h acts through the gate alone
    theta["gate"] = torch.eye(2)[None]
    features, action = torch.randn(1, 6, 3), torch.rand(1, 6, 2) * 2 - 1
    broken = model.network(theta, torch.cat([features, action], dim=-1), torch.tensor([[[0.0, gain - 1.0]]]))
    weaker = torch.cat([features, action * torch.tensor([1.0, gain])], dim=-1)
    intact = model.network(theta, weaker, torch.zeros(1, 1, 2))
    torch.testing.assert_close(broken, intact)


@pytest.mark.parametrize(("gate_actions", "interaction_rank", "acts"), [(True, 0, 1), (False, 3, 1), (True, 3, 0)])
def test_faults_add_up_in_the_first_layer(gate_actions: bool, interaction_rank: int, acts: int) -> None:
    """h_1 + h_2 does there what h_1 and h_2 do, each by itself; where both are linear, for observations at least."""
    model = simple_model(gate_actions=gate_actions, interaction_rank=interaction_rank).double()
    theta = {name: value.double() for name, value in parameters(model, 1)[0].items()}
    intact, one, other = torch.randn(3, 1, model.embeddings.shape[-1], dtype=torch.float64)
    x = torch.randn(1, 7, model.n_features + model.action_dim, dtype=torch.float64)
    x[..., model.n_features :] *= acts

    def effect(h: torch.Tensor) -> torch.Tensor:
        (weight, bias), (intact_weight, intact_bias) = (model.network.folded(theta, each)[0] for each in (h, intact))
        return x @ (weight - intact_weight) + bias - intact_bias

    torch.testing.assert_close(effect(one + other - intact), effect(one) + effect(other))
    assert effect(one).std(dim=1).min() > 0.1  # more than a bias


def test_interaction_is_bilinear() -> None:
    model = simple_model(interaction_rank=2, gate_actions=False)
    theta, h = parameters(model)
    x = torch.randn(2, 6, model.n_features + model.action_dim)
    U, V, C = (theta[f"interaction_{name}"] for name in ("input", "situation", "output"))
    z = x @ theta["weight_0"] + theta["bias_0"][:, None] + h[:, None] @ theta["embedding"]
    z = z + ((x @ U) * (h[:, None] @ V)) @ C
    hidden = F.silu(F.silu(z) @ theta["weight_1"] + theta["bias_1"][:, None])
    expected = hidden @ theta["weight_2"] + theta["bias_2"][:, None]
    torch.testing.assert_close(model.network(theta, x, h[:, None]), expected)


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


def test_situations_share_all_layers_but_the_first() -> None:
    model = simple_model(interaction_rank=3, hidden=(6, 5))
    theta, _ = parameters(model)
    h, x = torch.randn(2 * 4, model.embeddings.shape[-1]), torch.randn(2 * 4, 7, model.n_features + model.action_dim)
    layers = model.network.folded(theta, h)
    assert [len(weight) for weight, _ in layers] == [8, 2, 2]
    copies = {name: value.repeat_interleave(4, dim=0) for name, value in theta.items()}
    torch.testing.assert_close(
        model.network.through(layers, x), model.network(copies, x, h[:, None]), rtol=1e-4, atol=1e-4
    )
