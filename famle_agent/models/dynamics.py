"""The situation-conditioned dynamics model p_theta(s' | s, a, h) (the paper's section IV-A).

B models are computed at once: of situations while meta-learning, of robots while deployed. Each of them is an ensemble
of P members with parameters theta (B, P, ...) and embeddings h (B, P, embedding_dim) of their own. The axis of members
is this package's business: data of B robots go to all members, and likelihoods and returns are means over the members.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from famle_agent.models.likelihood import fitted_scale, log_density
from famle_agent.models.network import Network, Theta
from famle_agent.models.observation import ObservationLayout
from famle_agent.models.scale import deviations

__all__ = ["Batch", "Dynamics", "Theta"]

_NOISE_SAMPLES = 50_000  # transitions that the noise is fitted to


@dataclass(frozen=True)
class Batch:
    """Encoded transitions of B situations or robots, n each; or of each member its own, with an axis P after B.

    Attributes:
        x: Normalised inputs, (B, n, n_features + action_dim) or (B, P, n, n_features + action_dim).
        y: Normalised targets, (B, n, obs_dim) or (B, P, n, obs_dim).
        weight: 1 for a transition that counts and 0 for padding, (B, n) or (B, P, n).
    """

    x: Tensor
    y: Tensor
    weight: Tensor

    def __getitem__(self, index: tuple[Tensor, Tensor]) -> Batch:
        """Takes transitions i of situations c: ``batch[c, i]``."""
        c, i = index
        row = c * self.weight.shape[1] + i

        def taken(values: Tensor) -> Tensor:  # faster than values[c, i]
            return values.flatten(0, 1).index_select(0, row.flatten()).view(*row.shape, *values.shape[2:])

        return Batch(taken(self.x), taken(self.y), taken(self.weight))


class Dynamics(nn.Module):
    """Gaussian or Student-t p(s' | s, a, h): a network predicts the normalised change of the state.

    :class:`~famle_agent.models.observation.ObservationLayout` says what the network sees of an observation, and
    :class:`~famle_agent.models.network.Network` what h does to it.

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
        interaction_rank: R, of a bilinear map of inputs and embedding; 0 is the paper's network.
        members: P, independent networks with embeddings of their own; 1 is the paper's.
        degrees_of_freedom: Of a Student-t likelihood, which forgives what no model predicts, contacts above all;
            0 is a Gaussian (the paper's).
        activation: Of the hidden layers, ``"silu"`` or ``"relu"``.
        output_limit: L, which the normalised change cannot exceed; 0 leaves it free.
        normalise_actions: Whether the network sees actions of zero mean and unit deviation over the data, instead of
            actions in [-1, 1].
        initial_weights: ``"normal"``, or ``"uniform"`` as PyTorch has them by itself and so the authors.
        robots: R, robots with networks of their own; 1 is a model that any number of robots share.

    Attributes:
        theta: Parameters by name, (R * P, ...); :meth:`theta_of` gives them with axes of their own.
        embeddings: H, the embedding of each training situation, (R * P, N, embedding_dim).
        noise_std: Deviations of the targets from the mean, (R * P, obs_dim).
        usual_error: Root mean square, in these deviations, of what is new in the errors on robots of known situations
            that the agent drives, (). Above 1 where it drives them to places that its data hold little of.
    """

    input_mean: Tensor
    input_std: Tensor
    action_mean: Tensor
    action_std: Tensor
    target_mean: Tensor
    target_std: Tensor
    noise_std: Tensor
    usual_error: Tensor

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
        self.degrees_of_freedom, self.normalise_actions = degrees_of_freedom, normalise_actions
        self.layout = ObservationLayout(obs_dim, tuple(angle_dims), tuple(quaternion_dims), tuple(pose_dims))
        self.n_features = self.layout.n_features
        self.network = Network(
            self.n_features,
            action_dim,
            embedding_dim,
            tuple(hidden),
            outputs=obs_dim,
            gate_actions=gate_actions,
            interaction_rank=interaction_rank,
            activation=activation,
            output_limit=output_limit,
        )
        networks = robots * members
        self.theta = nn.ParameterDict(self.network.initial(networks, initial_weights))
        self.embeddings = nn.Parameter(torch.randn(networks, n_situations, embedding_dim, dtype=torch.float32))

        # Where actions are not normalised theirs stay as they are, and files do not have them.
        for name, size in (("input", self.n_features), ("action", action_dim), ("target", obs_dim)):
            kept = name != "action" or normalise_actions
            self.register_buffer(f"{name}_mean", torch.zeros(size, dtype=torch.float32), persistent=kept)
            self.register_buffer(f"{name}_std", torch.ones(size, dtype=torch.float32), persistent=kept)
        self.register_buffer("noise_std", torch.ones(networks, obs_dim, dtype=torch.float32))
        self.register_buffer("usual_error", torch.ones((), dtype=torch.float32))

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        state_dict.setdefault(f"{prefix}usual_error", torch.ones_like(self.usual_error))  # older files have none
        super()._load_from_state_dict(state_dict, prefix, *args)

    @property
    def n_situations(self) -> int:
        """N, the number of embeddings."""
        return self.embeddings.shape[1]

    @property
    def members(self) -> int:
        """P, the networks of the ensemble."""
        return self.embeddings.shape[0] // self.robots

    # --- parameters -------------------------------------------------------------------------------------

    def parameters_of(self, robots: int) -> Theta:
        """Returns theta for B robots, (B, P, ...), through which gradients reach the model.

        Raises:
            ValueError: The model is of other robots.
        """
        return {name: self._of(value, robots) for name, value in self.theta.items()}

    def theta_of(self, robots: int) -> Theta:
        """Returns theta for B robots without gradients, (B, P, ...); errors as of :meth:`parameters_of`."""
        return {name: self._of(value.detach(), robots) for name, value in self.theta.items()}

    def embeddings_of(self, c: Tensor) -> Tensor:
        """Returns the embeddings of situations c (B,) without gradients, (B, P, embedding_dim)."""
        H = self.embeddings_for(len(c))
        return H[torch.arange(len(c), device=H.device), :, self.embedding_index(c)]

    def embeddings_for(self, robots: int) -> Tensor:
        """Returns H for B robots without gradients, (B, P, N, embedding_dim); errors as of :meth:`parameters_of`."""
        return self._of(self.embeddings.detach(), robots)

    def embeddings_by_row(self, c: Tensor) -> Tensor:
        """Returns an embedding for each transition's situation c, (1, P, n) -> (1, P, n, embedding_dim)."""
        member = torch.arange(self.members, device=c.device)[:, None]
        return self.embeddings[member, self.embedding_index(c)]

    def embedding_index(self, c: Tensor) -> Tensor:
        """Says which embeddings belong to situations c: a model with a single one has it for all of them."""
        return c if self.n_situations > 1 else torch.zeros_like(c)

    def _of(self, values: Tensor, robots: int) -> Tensor:
        """Gives values of all networks, (R * P, ...), to B robots, (B, P, ...)."""
        if self.robots == 1:
            return values.expand(robots, *values.shape)
        if robots != self.robots:
            raise ValueError(f"The model has networks for {self.robots} robots, not for {robots}.")
        return values.view(robots, -1, *values.shape[1:])

    # --- data -------------------------------------------------------------------------------------------

    def fit_normalisation(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> None:
        """Takes means and deviations over all leading axes of the data, (..., dim) each."""
        size = torch.maximum(obs.abs(), next_obs.abs()).flatten(0, -2).amax(dim=0)  # (obs_dim,)
        named = {
            "input": (self.layout.features(obs), None),
            "target": (self.layout.change(obs, next_obs), size),
        }
        if self.normalise_actions:
            named["action"] = action, None
        for name, (values, size_of_terms) in named.items():
            flat = values.flatten(0, -2)
            getattr(self, f"{name}_std").copy_(deviations(flat, size_of_terms))
            getattr(self, f"{name}_mean").copy_(flat.mean(dim=0))

    def inputs(self, obs: Tensor, action: Tensor) -> Tensor:
        """Normalises observations and actions in [-1, 1], (..., dim) each, for the network."""
        features = (self.layout.features(obs) - self.input_mean) / self.input_std
        if self.normalise_actions:
            action = (action - self.action_mean) / self.action_std
        return torch.cat([features, action], dim=-1)

    def encode(self, obs: Tensor, action: Tensor, next_obs: Tensor, weight: Tensor | None = None) -> Batch:
        """Normalises transitions, (B, n, ...) each, for the losses below. Actions lie in [-1, 1] already."""
        targets = (self.layout.change(obs, next_obs) - self.target_mean) / self.target_std
        weight = obs.new_ones(obs.shape[:-1]) if weight is None else weight
        return Batch(self.inputs(obs, action), targets, weight)

    # --- predictions ------------------------------------------------------------------------------------

    def forward(self, x: Tensor, h: Tensor, theta: Theta | None = None) -> Tensor:
        """Computes the mean of the normalised targets in each member, (B, P, n, obs_dim).

        Args:
            x: Normalised inputs, (B, n, inputs), or (B, P, n, inputs) where each member has its own.
            h: Embeddings, (B, P, embedding_dim), or one for each row, (B, P, n, embedding_dim).
            theta: Parameters, (B, P, ...); None takes the model's own.

        Raises:
            ValueError: The embeddings have another shape, or the model is of other robots.
        """
        if h.ndim not in (3, 4) or h.shape[1] != self.members:
            raise ValueError(
                f"Embeddings must have shape (B, {self.members}, embedding_dim) for a model of {self.members} members, "
                f"as embeddings_of(situations) gives them; got {tuple(h.shape)}."
            )
        B, P = h.shape[:2]
        theta = self.parameters_of(B) if theta is None else theta
        x = _with_members(x).expand(B, P, -1, -1)
        h = h if h.ndim == 4 else h[:, :, None]
        networks = {name: value.flatten(0, 1) for name, value in theta.items()}  # (B * P, ...)
        out = self.network(networks, x.flatten(0, 1), h.flatten(0, 1))
        return out.view(B, P, *out.shape[1:])

    def predict(self, obs: Tensor, action: Tensor, h: Tensor, theta: Theta | None = None) -> Tensor:
        """Predicts the next observations in each member, (B, P, n, obs_dim), angles not wrapped.

        Args:
            obs: Observations, (B, n, obs_dim), or (B, P, n, obs_dim) where each member has its own.
            action: Actions in [-1, 1], as ``obs``.
            h: As for :meth:`forward`.
            theta: As for :meth:`forward`.
        """
        change = self.forward(self.inputs(obs, action), h, theta) * self.target_std + self.target_mean
        return self.layout.advance(_with_members(obs), change)

    def loss(self, batch: Batch, h: Tensor, theta: Theta | None = None) -> Tensor:
        """Computes -log p of unit variance in each member, constants left out, (B, P): L(theta, h), eq. 7 of the paper.

        A mean over the weighted transitions and over the target dimensions.

        Args:
            batch: Transitions.
            h: As for :meth:`forward`.
            theta: As for :meth:`forward`.
        """
        y, weight = _with_members(batch.y), _with_members(batch.weight, axes=3)
        error = (self.forward(batch.x, h, theta) - y).square().mean(dim=-1)  # (B, P, n)
        return 0.5 * (error * weight).sum(dim=-1) / weight.sum(dim=-1).clamp(min=1.0)

    def residuals(self, batch: Batch, h: Tensor, theta: Theta | None = None) -> Tensor:
        """Computes the errors of the normalised targets, in fitted deviations, (B, P, n, obs_dim).

        Arguments as for :meth:`loss`; padding has errors, too.
        """
        noise = self._of(self.noise_std, len(h))[:, :, None]  # (B, P, 1, obs_dim)
        return (self.forward(batch.x, h, theta) - _with_members(batch.y)) / noise

    def log_density(self, residual: Tensor, excess: Tensor | float = 1.0) -> Tensor:
        """Computes log p(s' | s, a, h) of normalised targets by their residuals, a mean over the members, (B, n).

        Args:
            residual: As of :meth:`residuals`, (B, P, n, obs_dim).
            excess: By how much the noise is above the fitted one, broadcast to the residuals.
        """
        noise = self._of(self.noise_std, len(residual))[:, :, None] * excess
        log_p = (log_density(residual / excess, self.degrees_of_freedom) - noise.log()).sum(dim=-1)
        # An observation beyond all measure would make every likelihood -inf and a posterior meaningless.
        return log_p.mean(dim=1).clamp(min=-1e30)

    @torch.no_grad()
    def fit_noise(self, batch: Batch) -> None:
        """Sets the deviations to their maximum-likelihood values on the training situations, (N, n) transitions."""
        stride = -(-batch.weight.numel() // _NOISE_SAMPLES)
        x, y, weight = (values[:, ::stride] for values in (batch.x, batch.y, batch.weight))
        c = torch.arange(len(x), device=x.device).repeat_interleave(x.shape[1])  # (N * n,)
        h = self.embeddings_by_row(c.expand(1, self.members, -1))
        error = self.forward(x.flatten(0, 1)[None], h) - y.flatten(0, 1)  # (1, P, N * n, obs_dim)
        self.noise_std.copy_(fitted_scale(error[0].square(), weight.flatten(), self.degrees_of_freedom))


def _with_members(values: Tensor, axes: int = 4) -> Tensor:
    """Gives values of B robots, (B, n, ...), an axis of members, (B, 1, n, ...), where they have none."""
    return values if values.ndim == axes else values[:, None]
