"""The situation-conditioned dynamics model p_theta(s' | s, a, h) (the paper's section IV-A).

Every function takes a leading axis B of independent networks: situations while meta-learning, robots while deployed,
and in each of these the P members of an ensemble, which see the same transitions (index = robot * P + member). Robots
share what was meta-learned, but for a model made by :meth:`Dynamics.for_robots`.
Parameters are stacked along it, so that B networks cost one batched matrix product a layer.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own custom)

from famle_agent.models.observation import ObservationLayout

__all__ = ["Batch", "Dynamics", "Network", "Simulator", "Theta", "expand"]

Theta = dict[str, Tensor]
"""Network parameters by name; stacked parameters have a leading axis B."""

Network = list[tuple[Tensor, Tensor]]
"""Layers (weight (B, in, out), bias (B, 1, out)) of B networks whose situation is fixed."""

_NOISE_SAMPLES = 50_000  # transitions that the noise is fitted to
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
    """The parameters of P members (P, ...) for each of some robots or situations, (size * P, ...)."""
    if size == 1:
        return theta
    return {name: value.expand(size, *value.shape).flatten(0, 1) for name, value in theta.items()}


class Dynamics(nn.Module):
    """Gaussian or Student-t p(s' | s, a, h): a network predicts the normalised change of the state.

    What the network sees of an observation, :class:`~famle_agent.models.observation.ObservationLayout` says. The
    embedding h enters the first layer as a bias, which is what concatenating it to the input amounts to. With
    ``gate_actions``, it scales each action too,

        a' = (1 + G^T h) * a,

    so that a motor's gain, its sign included, is linear in h instead of something to be learnt piecewise. With an
    ``interaction_rank`` R, a bilinear map of rank R joins the first layer,

        z = W^T x + C^T ((U^T x) * (V^T h)),

    in which a sensor that is turned is linear in h. What is linear in h adds up: two faults are the sum of theirs.

    With an ``output_limit`` L, the normalised change is L tanh(z) of the network's last layer z, as in the authors'
    public code.

    Args:
        obs_dim: Number of observation dimensions.
        action_dim: Number of action dimensions.
        n_situations: Number of embeddings N; 1 is a model that does not tell situations apart.
        embedding_dim: Size of an embedding.
        hidden: Width of each hidden layer.
        angle_dims: Observation dimensions that are angles in rad.
        quaternion_dims: The four observation dimensions of a unit quaternion, or none.
        pose_dims: x, y and heading of a robot on a floor, or none.
        gate_actions: Whether the embedding scales the actions; False is the paper's network.
        interaction_rank: R; 0 is the paper's network.
        members: P, independent networks with embeddings of their own; 1 is the paper's.
        degrees_of_freedom: Of a Student-t likelihood, which forgives what no model predicts, contacts above all;
            0 is a Gaussian (the paper's).
        activation: Of the hidden layers, ``"silu"`` or ``"relu"``.
        output_limit: L; 0 leaves the output free.
        normalise_actions: Whether the network sees actions of zero mean and unit deviation over the data, instead of
            actions in [-1, 1].
        initial_weights: ``"normal"`` for deviations of 1 / sqrt(inputs) and no biases, ``"uniform"`` for weights and
            biases within 1 / sqrt(inputs), as PyTorch has them by itself and so the authors.
        robots: R, robots with networks of their own; 1 is a model that any number of robots share.

    Attributes:
        theta: Parameters of the members by name, (R * P, ...).
        embeddings: H, the embedding of each training situation, (R * P, N, embedding_dim).
    """

    input_mean: Tensor
    input_std: Tensor
    action_mean: Tensor
    action_std: Tensor
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
        quaternion_dims: Sequence[int] = (),
        pose_dims: Sequence[int] = (),
        gate_actions: bool = True,
        interaction_rank: int = 0,
        members: int = 1,
        degrees_of_freedom: float = 0.0,
        activation: Literal["silu", "relu"] = "silu",
        output_limit: float = 0.0,
        normalise_actions: bool = False,
        initial_weights: Literal["normal", "uniform"] = "normal",
        robots: int = 1,
    ) -> None:
        super().__init__()
        self.obs_dim, self.action_dim, self.robots = obs_dim, action_dim, robots
        self.activation, self.output_limit, self.normalise_actions = activation, output_limit, normalise_actions
        self.gate_actions, self.interaction_rank = gate_actions, interaction_rank
        self.degrees_of_freedom = degrees_of_freedom
        self.layout = ObservationLayout(obs_dim, tuple(angle_dims), tuple(quaternion_dims), tuple(pose_dims))
        self.n_features = self.layout.n_features
        self.n_layers = len(hidden) + 1

        networks = robots * members
        sizes = [self.n_features + action_dim, *hidden, obs_dim]
        theta = {}
        for layer, (fan_in, fan_out) in enumerate(pairwise(sizes)):
            theta[f"weight_{layer}"] = torch.randn(networks, fan_in, fan_out) / math.sqrt(fan_in)
            theta[f"bias_{layer}"] = torch.zeros(networks, fan_out)
        theta["embedding"] = torch.randn(networks, embedding_dim, sizes[1]) / math.sqrt(sizes[0] + embedding_dim)
        if initial_weights == "uniform":
            for layer, fan_in in enumerate((sizes[0] + embedding_dim, *hidden)):
                names = [f"weight_{layer}", f"bias_{layer}", *(["embedding"] if layer == 0 else [])]
                for name in names:
                    theta[name].uniform_(-1.0 / math.sqrt(fan_in), 1.0 / math.sqrt(fan_in))
        if gate_actions:
            theta["gate"] = torch.randn(networks, embedding_dim, action_dim) / math.sqrt(embedding_dim)
        if interaction_rank:
            shapes = {"input": (sizes[0], interaction_rank), "situation": (embedding_dim, interaction_rank)}
            shapes["output"] = (interaction_rank, sizes[1])
            for name, (fan_in, fan_out) in shapes.items():
                theta[f"interaction_{name}"] = torch.randn(networks, fan_in, fan_out) / math.sqrt(fan_in)
        self.theta = nn.ParameterDict(theta)
        self.embeddings = nn.Parameter(torch.randn(networks, n_situations, embedding_dim))

        self.register_buffer("input_mean", torch.zeros(self.n_features))
        self.register_buffer("input_std", torch.ones(self.n_features))
        # Where actions are not normalised these stay as they are, and files do not have them.
        self.register_buffer("action_mean", torch.zeros(action_dim), persistent=normalise_actions)
        self.register_buffer("action_std", torch.ones(action_dim), persistent=normalise_actions)
        self.register_buffer("target_mean", torch.zeros(obs_dim))
        self.register_buffer("target_std", torch.ones(obs_dim))
        self.register_buffer("noise_std", torch.ones(networks, obs_dim))

    @property
    def n_situations(self) -> int:
        """N, the number of embeddings."""
        return self.embeddings.shape[1]

    @property
    def members(self) -> int:
        """P, the networks of the ensemble."""
        return self.embeddings.shape[0] // self.robots

    def parameters_by_name(self) -> Theta:
        """Theta as plain tensors without gradient, (R * P, ...)."""
        return {name: value.detach() for name, value in self.theta.items()}

    def theta_of(self, robots: int) -> Theta:
        """Theta of B robots, (B * P, ...).

        Raises:
            ValueError: The model is of other robots.
        """
        if self.robots == 1:
            return expand(self.parameters_by_name(), robots)
        if robots != self.robots:
            raise ValueError(f"The model has networks for {self.robots} robots, not for {robots}.")
        return self.parameters_by_name()

    def with_members(self, count: int, first: int = 0) -> Dynamics:
        """A model of ``count`` of the members, from the one of index ``first`` on.

        Raises:
            ValueError: There are not as many.
        """
        if self.robots > 1:
            raise ValueError("A model of robots with networks of their own has no members to give.")
        if not (1 <= count <= self.members and 0 <= first <= self.members - count):
            raise ValueError(f"The ensemble has 1 to {self.members} members to give, not {count} from {first} on.")
        return self._with_networks(torch.arange(first, first + count))

    def for_robots(self, networks: Sequence[int]) -> Dynamics:
        """A model of as many robots, each of which has one of the members for its own network.

        Args:
            networks: The member of each robot.

        Raises:
            ValueError: There is no such member.
        """
        if self.robots > 1 or not all(0 <= network < self.members for network in networks):
            raise ValueError(f"There are members 0 to {self.members - 1} to give to robots, not {list(networks)}.")
        part = self._with_networks(torch.tensor(networks))
        part.robots = len(networks)
        return part

    def _with_networks(self, chosen: Tensor) -> Dynamics:
        part = copy.deepcopy(self)
        for owner, names in ((part.theta, list(self.theta)), (part, ["embeddings"])):
            for name in names:
                setattr(owner, name, nn.Parameter(getattr(owner, name).detach()[chosen].clone()))
        part.noise_std = self.noise_std[chosen].clone()
        return part

    def embedding_index(self, c: Tensor) -> Tensor:
        """Which embeddings belong to situations c: a model with a single one has it for all of them."""
        return c if self.n_situations > 1 else torch.zeros_like(c)

    def embeddings_of(self, c: Tensor) -> Tensor:
        """The embeddings of situations c (B,) in every member, (B * P, embedding_dim)."""
        index = self.embedding_index(c)
        if self.robots == 1:
            return self.embeddings.detach()[:, index].transpose(0, 1).flatten(0, 1)
        own = index.repeat_interleave(self.members)
        return self.embeddings.detach()[torch.arange(len(own), device=own.device), own]

    # --- data -------------------------------------------------------------------------------------------

    def features(self, obs: Tensor) -> Tensor:
        """What the network sees of observations, (..., obs_dim) -> (..., n_features)."""
        return self.layout.features(obs)

    def targets(self, obs: Tensor, next_obs: Tensor) -> Tensor:
        """The change of the state, (..., obs_dim)."""
        return self.layout.change(obs, next_obs)

    def fit_normalisation(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> None:
        """Takes means and deviations over all leading axes of the data, (..., dim) each."""
        named = {"input": self.features(obs), "target": self.targets(obs, next_obs)}
        if self.normalise_actions:
            named["action"] = action
        for name, values in named.items():
            flat = values.flatten(0, -2)
            std = flat.std(dim=0) if flat.shape[1] else flat.mean(dim=0)  # a model may see no more than the actions
            # A dimension that never varies carries nothing and must not be blown up.
            getattr(self, f"{name}_std").copy_(torch.where(std > 1e-6, std, 1.0))
            getattr(self, f"{name}_mean").copy_(flat.mean(dim=0))

    def encode(self, obs: Tensor, action: Tensor, next_obs: Tensor, weight: Tensor | None = None) -> Batch:
        """Normalises transitions, (B, n, ...) each, for the losses below. Actions lie in [-1, 1] already."""
        features = (self.features(obs) - self.input_mean) / self.input_std
        targets = (self.targets(obs, next_obs) - self.target_mean) / self.target_std
        weight = torch.ones(obs.shape[:-1], device=obs.device) if weight is None else weight
        if self.normalise_actions:
            action = (action - self.action_mean) / self.action_std
        return Batch(torch.cat([features, action], dim=-1), targets, weight)

    # --- the network ------------------------------------------------------------------------------------

    def network(self, theta: Theta, h: Tensor) -> Network:
        """Fixes the situation of B networks: what h does to the first layer becomes part of its weights.

        Args:
            theta: Stacked parameters.
            h: Embeddings, (B, embedding_dim).
        """
        weight = theta["weight_0"]
        if self.interaction_rank:
            scale = torch.einsum("be,ber->br", h, theta["interaction_situation"])
            weight = torch.baddbmm(weight, theta["interaction_input"] * scale[:, None], theta["interaction_output"])
        if self.gate_actions:
            gate = 1.0 + torch.einsum("be,bea->ba", h, theta["gate"])
            weight = torch.cat([weight[:, : self.n_features], gate[..., None] * weight[:, self.n_features :]], dim=1)
        bias = theta["bias_0"] + torch.einsum("be,beo->bo", h, theta["embedding"])
        layers = [(weight, bias[:, None])]
        for layer in range(1, self.n_layers):
            layers.append((theta[f"weight_{layer}"], theta[f"bias_{layer}"][:, None]))
        return layers

    def forward(self, network: Network, x: Tensor) -> Tensor:
        """Mean of the normalised targets, (B, n, obs_dim), for normalised inputs (B, n, inputs)."""
        for weight, bias in network[:-1]:
            x = self._activate(torch.baddbmm(bias, x, weight), inplace=not torch.is_grad_enabled())
        weight, bias = network[-1]
        z = torch.baddbmm(bias, x, weight)
        return self.output_limit * z.tanh() if self.output_limit else z

    def _activate(self, z: Tensor, inplace: bool = False) -> Tensor:
        return F.silu(z, inplace=inplace) if self.activation == "silu" else F.relu(z, inplace=inplace)

    def predict(self, theta: Theta, h: Tensor, x: Tensor) -> Tensor:
        """As :meth:`forward`, with an embedding for each row: the same networks see many situations at once.

        Args:
            theta: Stacked parameters.
            h: (B, n, embedding_dim), or (B, 1, embedding_dim) for one situation in all rows.
            x: Normalised inputs, (B, n, inputs).
        """
        if self.gate_actions:
            gate = 1.0 + h @ theta["gate"]
            x = torch.cat([x[..., : self.n_features], gate * x[..., self.n_features :]], dim=-1)
        z = torch.baddbmm(theta["bias_0"][:, None], x, theta["weight_0"]) + h @ theta["embedding"]
        if self.interaction_rank:
            interaction = (x @ theta["interaction_input"]) * (h @ theta["interaction_situation"])
            z = torch.baddbmm(z, interaction, theta["interaction_output"])
        layers = range(1, self.n_layers)
        rest = [(theta[f"weight_{layer}"], theta[f"bias_{layer}"][:, None]) for layer in layers]
        return self.forward(rest, self._activate(z))

    def loss(self, theta: Theta, h: Tensor, batch: Batch) -> Tensor:
        """Negative log-likelihood L(theta, h) of unit variance, constants left out, (B,); eq. 6 of the paper.

        A mean over the weighted transitions and over the target dimensions.

        Args:
            theta: Stacked parameters.
            h: (B, embedding_dim), or one for each transition, (B, n, embedding_dim).
            batch: Transitions.
        """
        error = (self.predict(theta, _rows(h), batch.x) - batch.y).square().mean(dim=-1)
        return 0.5 * (error * batch.weight).sum(dim=1) / batch.weight.sum(dim=1).clamp(min=1.0)

    def log_likelihood(self, theta: Theta, h: Tensor, batch: Batch) -> Tensor:
        """Log p(s' | s, a, h) of each normalised transition, (B, n), with the fitted noise; 0 for padding.

        Arguments as for :meth:`loss`.
        """
        noise = self.noise_std.repeat(len(batch.x) // len(self.noise_std), 1)[:, None]
        residual = (self.predict(theta, _rows(h), batch.x) - batch.y) / noise
        return (self._log_density(residual) - noise.log()).sum(dim=-1) * batch.weight

    def _log_density(self, residual: Tensor) -> Tensor:
        nu = self.degrees_of_freedom
        if not nu:
            return -0.5 * residual.square() - 0.5 * math.log(2 * math.pi)
        constant = math.lgamma((nu + 1) / 2) - math.lgamma(nu / 2) - 0.5 * math.log(nu * math.pi)
        return constant - (nu + 1) / 2 * torch.log1p(residual.square() / nu)

    @torch.no_grad()
    def fit_noise(self, batch: Batch) -> None:
        """Sets the deviations to their maximum-likelihood values on the training situations, (N, n) transitions."""
        nu, stride = self.degrees_of_freedom, -(-batch.weight.numel() // _NOISE_SAMPLES)
        x, y, weight = (values[:, ::stride] for values in (batch.x, batch.y, batch.weight))
        rows = x.shape[1]
        h = self.embeddings.expand(-1, len(x), -1).repeat_interleave(rows, dim=1)  # (P, N * rows, embedding_dim)
        x = x.flatten(0, 1).expand(self.members, -1, -1)
        squared = (self.predict(self.parameters_by_name(), h, x) - y.flatten(0, 1)).square()
        weight = weight.reshape(1, -1, 1)
        least = _MIN_STD**2
        variance = ((squared * weight).sum(dim=1, keepdim=True) / weight.sum()).clamp(min=least)
        for _ in range(20 if nu else 0):
            # Expectation maximisation: a Student-t is a Gaussian whose variance is drawn anew for each value.
            trust = weight * (nu + 1) / (nu + squared / variance)
            variance = ((squared * trust).sum(dim=1, keepdim=True) / weight.sum()).clamp(min=least)
        self.noise_std.copy_(variance[:, 0].sqrt())

    def simulator(self, theta: Theta, h: Tensor) -> Simulator:
        """B models of fixed situation for planning, with the normalisation folded into their outer layers."""
        return Simulator(self, self.network(theta, h))


class Simulator:
    """The mean of p(s' | s, a, h) in units of the environment, for many candidates at once."""

    def __init__(self, model: Dynamics, network: Network) -> None:
        self._model = model
        (first_weight, first_bias), (last_weight, last_bias) = network[0], network[-1]
        from_features = first_weight[:, : model.n_features] / model.input_std[:, None]
        bias = first_bias - (model.input_mean @ from_features)[:, None]
        from_actions = first_weight[:, model.n_features :]
        if model.normalise_actions:
            from_actions = from_actions / model.action_std[:, None]
            bias = bias - (model.action_mean @ from_actions)[:, None]
        first = torch.cat([model.layout.weights_for_inputs(from_features), from_actions], dim=1), bias
        if not model.output_limit:  # a limit stands between the last layer and the units of the environment
            last_weight = last_weight * model.target_std
            last_bias = last_bias * model.target_std + model.target_mean
        self._network = [first, *network[1:-1], (last_weight, last_bias)]

    def __call__(self, obs: Tensor, action: Tensor) -> Tensor:
        """Predicts the next observations, (B, n, obs_dim), angles not wrapped.

        Args:
            obs: Observations, (B, n, obs_dim).
            action: Actions in [-1, 1], (B, n, action_dim).
        """
        inputs = torch.cat([*self._model.layout.inputs(obs), action], dim=-1)
        change = self._model.forward(self._network, inputs)
        if self._model.output_limit:
            change = change * self._model.target_std + self._model.target_mean
        return self._model.layout.advance(obs, change)


def _rows(h: Tensor) -> Tensor:
    """Embeddings with an axis of transitions."""
    return h if h.ndim == 3 else h[:, None]
