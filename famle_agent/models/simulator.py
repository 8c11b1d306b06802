"""The adapted model made fast for planning (line 4): its situation is fixed, and folded into the weights."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from famle_agent.models.dynamics import Dynamics
from famle_agent.models.network import Layers, Theta
from famle_agent.models.observation import ObservationLayout
from famle_agent.models.reward import Objective

__all__ = ["Simulator", "imagine"]

_CANDIDATES_AT_ONCE = {"cpu": 2500, "cuda": 1_000_000}
"""By kind of device: what stays in a processor's cache over the whole horizon, or fills a GPU."""

_FEWEST_AT_ONCE = 64
"""Of each network, since reading its weights once more takes as long as judging some tens of candidates."""


class Simulator:
    """Predicts as :meth:`Dynamics.predict` does, for B robots whose theta and h do not change.

    What h does to the first layer, the normalisation and the choice of features become part of the weights. Robots with
    theta_meta share all other layers, so that one matrix product serves all of them.

    Args:
        model: Says what the parameters mean.
        h: Embeddings, (B, P, embedding_dim).
        theta: Parameters, (B, P, ...); None takes theta_meta.
        within: Least and largest value of each observed number, (B, obs_dim) each, beyond which nothing is predicted;
            None predicts anything.

    Raises:
        ValueError: The embeddings have another shape, or the model is of other robots.
    """

    def __init__(
        self, model: Dynamics, h: Tensor, theta: Theta | None = None, within: tuple[Tensor, Tensor] | None = None
    ) -> None:
        if h.ndim != 3 or h.shape[1] != model.members:
            raise ValueError(
                f"Embeddings must have shape (B, {model.members}, embedding_dim) for a model of {model.members} "
                f"members, as embeddings_of(situations) gives them; got {tuple(h.shape)}."
            )
        self._model, (self._robots, self._members) = model, h.shape[:2]
        self._shares = theta is None and model.robots == 1
        theta = model.theta_of(1 if self._shares else self._robots) if theta is None else theta
        networks = {name: value.flatten(0, 1) for name, value in theta.items()}  # (P, ...), or (B * P, ...)
        self._layers = _in_units_of_the_environment(model, model.network.folded(networks, self.rows(h)))
        self._within: tuple[Tensor, Tensor] | None = None
        if within is not None:
            low, high = (self.rows(bound[:, None])[:, None] for bound in within)
            self._within = low, high

    @property
    def action_dim(self) -> int:
        """Number of action dimensions."""
        return self._model.action_dim

    @property
    def members(self) -> int:
        """P, rows for each robot."""
        return self._members

    def __call__(self, obs: Tensor, action: Tensor) -> Tensor:
        """Predicts the next observations in each member, (B, P, n, obs_dim), angles not wrapped.

        Args:
            obs: Observations, (B, n, obs_dim), or (B, P, n, obs_dim) where the members disagree already.
            action: Actions in [-1, 1], (B, n, action_dim) or (B, P, n, action_dim).
        """
        rows = (self.rows(values if values.ndim == 4 else values[:, None]) for values in (obs, action))
        return self.of_robots(self._step(*rows))

    def rows(self, values: Tensor) -> Tensor:
        """Turns values of each member of each robot, (B, P, ...) or (B, 1, ...), into rows as an objective sees them.

        Returns:
            A row for each member of each robot, (B * P, ...): row member * B + robot where robots share their networks,
            else robot * P + member.
        """
        values = values.expand(-1, self._members, *values.shape[2:])
        return (values.transpose(0, 1) if self._shares else values).flatten(0, 1)

    def of_robots(self, rows: Tensor) -> Tensor:
        """Turns such rows into values of each member of each robot, (B * P, ...) -> (B, P, ...)."""
        if self._shares:
            return rows.view(self._members, self._robots, *rows.shape[1:]).transpose(0, 1)
        return rows.view(self._robots, self._members, *rows.shape[1:])

    def returns(self, objective: Objective, obs: Tensor, actions: Tensor) -> Tensor:
        """Computes what candidate sequences of actions yield, (B, N), a mean over the members of the ensemble.

        A planner finds what a single model is wrong about; that several are wrong in the same way is rarer.

        Args:
            objective: What counts; it is given :meth:`rows`.
            obs: Where the robots are, (B, obs_dim).
            actions: Candidates in [-1, 1], (B, N, H, action_dim).
        """
        return self.returns_of_members(objective, obs, actions).mean(dim=1)

    def returns_of_members(self, objective: Objective, obs: Tensor, actions: Tensor) -> Tensor:
        """Computes the same in each member of the ensemble, (B, P, N); arguments as of :meth:`returns`."""
        return self.of_robots(imagine(self._step, objective, self.rows(obs[:, None]), self.rows(actions[:, None])))

    def _step(self, obs: Tensor, action: Tensor) -> Tensor:
        """Predicts the next observations from a row for each member of each robot, (B * P, n, ...)."""
        model = self._model
        change = model.network.through(self._layers, torch.cat([*_inputs(model.layout, obs), action], dim=-1))
        if model.network.output_limit:
            change = change * model.target_std + model.target_mean
        next_obs = model.layout.advance(obs, change)
        return next_obs if self._within is None else next_obs.clamp(*self._within)


def imagine(model: Callable[[Tensor, Tensor], Tensor], objective: Objective, obs: Tensor, actions: Tensor) -> Tensor:
    """Sums the rewards of candidate sequences in K models (the paper's eq. 14).

    Args:
        model: One step of many candidates: (K, N, obs_dim), (K, N, action_dim) -> next observations (K, N, obs_dim).
        objective: What counts.
        obs: Where the candidates begin, (K, obs_dim).
        actions: Candidates in [-1, 1], (K, N, H, action_dim).

    Returns:
        The return of each candidate, (K, N); -inf where a model left the finite numbers.
    """
    at_once = _candidates_at_once(actions)
    returns = [_imagine(model, objective, obs, part) for part in torch.split(actions, at_once, dim=1)]
    return torch.cat(returns, dim=1).nan_to_num(nan=-math.inf, posinf=-math.inf, neginf=-math.inf)


def _imagine(model: Callable[[Tensor, Tensor], Tensor], objective: Objective, obs: Tensor, actions: Tensor) -> Tensor:
    path = [obs[:, None].expand(-1, actions.shape[1], -1)]  # (K, N, obs_dim) each
    for action in actions.unbind(dim=2):
        path.append(model(path[-1], action))
    states = torch.stack(path, dim=1)  # (K, H + 1, N, obs_dim)
    gamma = objective.discount ** torch.arange(len(path), dtype=states.dtype, device=states.device)
    weight = gamma[:, None].expand(states.shape[:3])
    if objective.termination_fn is not None:
        ended = objective.termination_fn(states[:, 1:].flatten(1, 2)).view(states[:, 1:].shape[:3])
        goes_on = (1.0 - ended.to(states.dtype)).cumprod(dim=1)
        weight = weight * torch.cat([torch.ones_like(goes_on[:, :1]), goes_on], dim=1)
    total = (weight[:, :-1] * _rewards(objective, states, actions)).sum(dim=1)
    return total if objective.value_fn is None else total + weight[:, -1] * objective.value_fn(path[-1])


def _rewards(objective: Objective, states: Tensor, actions: Tensor) -> Tensor:
    """Computes the rewards of all steps, (K, H, N), in calls of as many transitions as stay in the cache.

    Args:
        objective: Has the reward function.
        states: What each candidate goes through, (K, H + 1, N, obs_dim).
        actions: What it does, (K, N, H, action_dim).
    """
    transitions = states[:, :-1], actions.transpose(1, 2), states[:, 1:]
    at_once = _candidates_at_once(states)
    parts = zip(*(torch.split(values.flatten(1, 2), at_once, dim=1) for values in transitions), strict=True)
    rewards = [
        torch.as_tensor(objective.reward_fn(*part), dtype=states.dtype, device=states.device).expand(part[0].shape[:2])
        for part in parts
    ]
    return torch.cat(rewards, dim=1).view(states[:, 1:].shape[:3])


def _candidates_at_once(values: Tensor) -> int:
    """Says how many candidates to judge at once in each of K networks, given values (K, ...) of theirs."""
    of_all = _CANDIDATES_AT_ONCE.get(values.device.type, _CANDIDATES_AT_ONCE["cpu"])
    return max(_FEWEST_AT_ONCE, of_all // len(values))


def _in_units_of_the_environment(model: Dynamics, layers: Layers) -> Layers:
    """Folds the normalisation and the choice of features into the outer layers of K networks."""
    (first_weight, first_bias), (last_weight, last_bias) = layers[0], layers[-1]
    from_features = first_weight[:, : model.n_features] / model.input_std[:, None]
    bias = first_bias - (model.input_mean @ from_features)[:, None]
    from_actions = first_weight[:, model.n_features :]
    if model.normalise_actions:
        from_actions = from_actions / model.action_std[:, None]
        bias = bias - (model.action_mean @ from_actions)[:, None]
    first = torch.cat([_weights_for_inputs(model.layout, from_features), from_actions], dim=1), bias
    if not model.network.output_limit:  # a limit stands between the last layer and the units of the environment
        last_weight = last_weight * model.target_std
        last_bias = last_bias * model.target_std + model.target_mean
    return [first, *layers[1:-1], (last_weight, last_bias)]


def _inputs(layout: ObservationLayout, obs: Tensor) -> list[Tensor]:
    """Computes the features of a layout in parts that copy little, to be concatenated in order.

    All of the observation goes in as it is, and all 16 products of a quaternion instead of the 10 that differ.
    """
    parts = [obs]
    if layout.angle_dims:
        angles = _take(obs, layout.angle_dims)
        parts += [angles.sin(), angles.cos()]
    if layout.quaternion_dims:
        q = _take(obs, layout.quaternion_dims)
        parts.append((q[..., None] * q[..., None, :]).flatten(-2))
    return parts


def _weights_for_inputs(layout: ObservationLayout, weight: Tensor) -> Tensor:
    """Turns first-layer weights for features, (K, n_features, out), into those for :func:`_inputs`.

    What enters otherwise or not at all has weights of 0.
    """
    other = layout.other_dims
    from_other, angles, products = weight.tensor_split([len(other), len(other) + 2 * len(layout.angle_dims)], dim=1)
    plain = weight.new_zeros(len(weight), layout.obs_dim, weight.shape[2])
    plain[:, other] = from_other
    square = weight.new_zeros(len(weight), len(layout.quaternion_dims) ** 2, weight.shape[2])
    square[:, [4 * i + j for i, j in layout.quaternion_pairs]] = products
    return torch.cat([plain, angles, square], dim=1)


def _take(values: Tensor, dims: tuple[int, ...]) -> Tensor:
    """Takes some of the last dimensions; a view where they follow each other."""
    if dims == tuple(range(dims[0], dims[-1] + 1)):
        return values[..., dims[0] : dims[-1] + 1]
    return values[..., list(dims)]
