"""The situation-conditioned dynamics model p_theta(s' | s, a, h) (the paper's section IV-A).

Every function takes a leading axis B: B situations while meta-learning, B robots while deployed, B
embeddings while the most likely one is selected. Parameters are stacked along it, so that B networks
cost one batched matrix product a layer.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own custom)

__all__ = ["Batch", "Dynamics", "Network", "Simulator", "Theta", "expand"]

Theta = dict[str, Tensor]
"""Network parameters by name; stacked parameters have a leading axis B."""

Network = list[tuple[Tensor, Tensor]]
"""Layers (weight (B, in, out), bias (B, 1, out)) of B networks whose situation is fixed."""

_MIN_STD = 1e-3  # of a normalised target; keeps the likelihood finite where the model is exact


@dataclass(frozen=True)
class Batch:
    """Encoded transitions of B situations, n each.

    Attributes:
        x: Normalised inputs, (B, n, n_features + action_dim).
        y: Normalised targets, (B, n, obs_dim).
        weight: 1 for a transition that counts and 0 for padding, (B, n).
    """

    x: Tensor
    y: Tensor
    weight: Tensor


def expand(theta: Theta, size: int) -> Theta:
    """Shows one set of parameters B times, without copying."""
    return {name: value.expand(size, *value.shape) for name, value in theta.items()}


class Dynamics(nn.Module):
    """Gaussian p(s' | s, a, h): a network predicts the normalised change of the state.

    Angles enter as sine and cosine, and their change is taken the short way round, so that a jump from pi to
    -pi is no event. The embedding h enters the first layer as a bias, which is what concatenating it to the
    input amounts to. With ``gate_actions``, it scales each action too,

        a' = (1 + G^T h) * a,

    so that a motor's gain, its sign included, is linear in h instead of something to be learnt piecewise.

    Args:
        obs_dim: Number of observation dimensions.
        action_dim: Number of action dimensions.
        n_situations: Number of embeddings N.
        embedding_dim: Size of an embedding.
        hidden: Width of each hidden layer.
        angle_dims: Observation dimensions that are angles in rad.
        gate_actions: Whether the embedding scales the actions; False is the paper's network.

    Attributes:
        theta: Parameters by name, without the axis B.
        embeddings: H, the embedding of each training situation, (N, embedding_dim).
    """

    input_mean: Tensor
    input_std: Tensor
    target_mean: Tensor
    target_std: Tensor
    noise_std: Tensor

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        n_situations: int,
        embedding_dim: int = 5,
        hidden: Sequence[int] = (70, 50),
        angle_dims: Sequence[int] = (),
        gate_actions: bool = True,
    ) -> None:
        super().__init__()
        self.obs_dim, self.action_dim = obs_dim, action_dim
        self.gate_actions = gate_actions
        self.angle_dims = list(angle_dims)
        self.other_dims = [dim for dim in range(obs_dim) if dim not in set(angle_dims)]
        self.n_features = len(self.other_dims) + 2 * len(self.angle_dims)
        self.n_layers = len(hidden) + 1

        sizes = [self.n_features + action_dim, *hidden, obs_dim]
        theta = {}
        for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            theta[f"weight_{layer}"] = torch.randn(fan_in, fan_out) / math.sqrt(fan_in)
            theta[f"bias_{layer}"] = torch.zeros(fan_out)
        theta["embedding"] = torch.randn(embedding_dim, sizes[1]) / math.sqrt(sizes[0] + embedding_dim)
        if gate_actions:
            theta["gate"] = torch.randn(embedding_dim, action_dim) / math.sqrt(embedding_dim)
        self.theta = nn.ParameterDict(theta)
        self.embeddings = nn.Parameter(torch.randn(n_situations, embedding_dim))

        self.register_buffer("input_mean", torch.zeros(self.n_features))
        self.register_buffer("input_std", torch.ones(self.n_features))
        self.register_buffer("target_mean", torch.zeros(obs_dim))
        self.register_buffer("target_std", torch.ones(obs_dim))
        self.register_buffer("noise_std", torch.ones(obs_dim))

    @property
    def n_situations(self) -> int:
        """N, the number of embeddings."""
        return len(self.embeddings)

    def parameters_by_name(self) -> Theta:
        """Theta as plain tensors without gradient."""
        return {name: value.detach() for name, value in self.theta.items()}

    # --- data -------------------------------------------------------------------------------------------

    def features(self, obs: Tensor) -> Tensor:
        """What the network sees of observations (..., obs_dim): angles as sine and cosine."""
        if not self.angle_dims:
            return obs
        angles = obs[..., self.angle_dims]
        return torch.cat([obs[..., self.other_dims], angles.sin(), angles.cos()], dim=-1)

    def targets(self, obs: Tensor, next_obs: Tensor) -> Tensor:
        """The change of the state, angles the short way round."""
        change = next_obs - obs
        if self.angle_dims:
            angle = change[..., self.angle_dims]
            change[..., self.angle_dims] = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
        return change

    def fit_normalisation(self, obs: Tensor, next_obs: Tensor) -> None:
        """Takes means and deviations over all leading axes of the data."""
        for name, values in (("input", self.features(obs)), ("target", self.targets(obs, next_obs))):
            flat = values.flatten(0, -2)
            std = flat.std(dim=0)
            # A dimension that never varies carries nothing and must not be blown up.
            getattr(self, f"{name}_std").copy_(torch.where(std > 1e-6, std, 1.0))
            getattr(self, f"{name}_mean").copy_(flat.mean(dim=0))

    def encode(self, obs: Tensor, action: Tensor, next_obs: Tensor, weight: Tensor | None = None) -> Batch:
        """Normalises transitions, (B, n, ...) each, for the losses below. Actions lie in [-1, 1] already."""
        features = (self.features(obs) - self.input_mean) / self.input_std
        targets = (self.targets(obs, next_obs) - self.target_mean) / self.target_std
        weight = torch.ones(obs.shape[:-1], device=obs.device) if weight is None else weight
        return Batch(torch.cat([features, action], dim=-1), targets, weight)

    # --- the network ------------------------------------------------------------------------------------

    def network(self, theta: Theta, h: Tensor) -> Network:
        """Fixes the situation of B networks.

        Args:
            theta: Stacked parameters.
            h: Embeddings, (B, embedding_dim).
        """
        weight, bias = theta["weight_0"], theta["bias_0"] + torch.einsum("be,beo->bo", h, theta["embedding"])
        if self.gate_actions:
            gate = 1.0 + torch.einsum("be,bea->ba", h, theta["gate"])
            weight = torch.cat([weight[:, : self.n_features], gate[..., None] * weight[:, self.n_features :]], dim=1)
        layers = [(weight, bias[:, None])]
        for layer in range(1, self.n_layers):
            layers.append((theta[f"weight_{layer}"], theta[f"bias_{layer}"][:, None]))
        return layers

    @staticmethod
    def forward(network: Network, x: Tensor) -> Tensor:
        """Mean of the normalised targets, (B, n, obs_dim), for normalised inputs (B, n, inputs)."""
        for weight, bias in network[:-1]:
            x = F.silu(torch.baddbmm(bias, x, weight), inplace=not torch.is_grad_enabled())
        weight, bias = network[-1]
        return torch.baddbmm(bias, x, weight)

    def loss(self, theta: Theta, h: Tensor, batch: Batch) -> Tensor:
        """Negative log-likelihood L(theta, h) of unit variance, constants left out, (B,); eq. 6 of the paper.

        A mean over the weighted transitions and over the target dimensions.
        """
        error = (self.forward(self.network(theta, h), batch.x) - batch.y).square().mean(dim=-1)
        return 0.5 * (error * batch.weight).sum(dim=1) / batch.weight.sum(dim=1).clamp(min=1.0)

    def log_likelihood(self, theta: Theta, h: Tensor, batch: Batch) -> Tensor:
        """Log p(s' | s, a, h) of each normalised transition, (B, n), with the fitted noise; 0 for padding."""
        residual = (self.forward(self.network(theta, h), batch.x) - batch.y) / self.noise_std
        density = -0.5 * residual.square() - self.noise_std.log() - 0.5 * math.log(2 * math.pi)
        return density.sum(dim=-1) * batch.weight

    @torch.no_grad()
    def fit_noise(self, batch: Batch) -> None:
        """Sets the Gaussian's deviations to their maximum-likelihood values on the training situations."""
        theta = expand(self.parameters_by_name(), self.n_situations)
        residual = self.forward(self.network(theta, self.embeddings), batch.x) - batch.y
        weight = batch.weight[..., None]
        variance = (residual.square() * weight).sum(dim=(0, 1)) / weight.sum()
        self.noise_std.copy_(variance.sqrt().clamp(min=_MIN_STD))

    def simulator(self, theta: Theta, h: Tensor) -> Simulator:
        """B models of fixed situation for planning, with the normalisation folded into their outer layers."""
        return Simulator(self, self.network(theta, h))


class Simulator:
    """The mean of p(s' | s, a, h) in units of the environment, for many candidates at once."""

    def __init__(self, model: Dynamics, network: Network) -> None:
        self._model = model
        (first_weight, first_bias), (last_weight, last_bias) = network[0], network[-1]
        obs_weight = first_weight[:, : model.n_features] / model.input_std[:, None]
        first = (
            torch.cat([obs_weight, first_weight[:, model.n_features :]], dim=1),
            first_bias - (model.input_mean @ obs_weight)[:, None],
        )
        last = (last_weight * model.target_std, last_bias * model.target_std + model.target_mean)
        self._network = [first, *network[1:-1], last]

    def __call__(self, obs: Tensor, action: Tensor) -> Tensor:
        """Predicts the next observations, (B, n, obs_dim), angles not wrapped.

        Args:
            obs: Observations, (B, n, obs_dim).
            action: Actions in [-1, 1], (B, n, action_dim).
        """
        x = torch.cat([self._model.features(obs), action], dim=-1)
        return obs + self._model.forward(self._network, x)
