"""What the numbers of an observation are, and so what a model should see of them and what it should predict."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from torch import Tensor

__all__ = ["DIMS", "ObservationLayout"]

DIMS = ("angle_dims", "quaternion_dims", "position_dims")
"""What an environment may say about its observation, by the names of its attributes."""


@dataclass(frozen=True)
class ObservationLayout:
    """The observation dimensions that are more than plain numbers.

    Angles enter a model as sine and cosine, and their change is taken the short way round, so that a jump from pi to
    -pi is no event. A quaternion q enters as the products q_i q_j, in which a rotation is linear and q and -q are
    the same. A position does not enter at all: a robot moves alike wherever it stands.

    Attributes:
        obs_dim: Number of observation dimensions.
        angle_dims: Those that are angles in rad.
        quaternion_dims: The four of a unit quaternion, or none.
        position_dims: Those on which the dynamics does not depend.
    """

    obs_dim: int
    angle_dims: tuple[int, ...] = ()
    quaternion_dims: tuple[int, ...] = ()
    position_dims: tuple[int, ...] = ()

    @property
    def other_dims(self) -> list[int]:
        """Dimensions that enter as they are."""
        special = {*self.angle_dims, *self.quaternion_dims, *self.position_dims}
        return [dim for dim in range(self.obs_dim) if dim not in special]

    @property
    def quaternion_pairs(self) -> list[tuple[int, int]]:
        """The pairs (i, j) of the products q_i q_j that differ."""
        return list(combinations_with_replacement(range(len(self.quaternion_dims)), 2))

    @property
    def n_features(self) -> int:
        """Size of what a model sees."""
        return len(self.other_dims) + 2 * len(self.angle_dims) + len(self.quaternion_pairs)

    def features(self, obs: Tensor) -> Tensor:
        """What a model sees of observations, (..., obs_dim) -> (..., n_features)."""
        other = self.other_dims
        if len(other) == self.obs_dim:
            return obs
        parts = [obs[..., other]]
        if self.angle_dims:
            angles = obs[..., self.angle_dims]
            parts += [angles.sin(), angles.cos()]
        if self.quaternion_dims:
            q = obs[..., self.quaternion_dims]
            left, right = zip(*self.quaternion_pairs, strict=True)
            parts.append(q[..., left] * q[..., right])
        return torch.cat(parts, dim=-1)

    def change(self, obs: Tensor, next_obs: Tensor) -> Tensor:
        """What a model predicts: next_obs - obs, (..., obs_dim), angles and quaternions the short way round."""
        change = next_obs - obs
        if self.angle_dims:
            angle = change[..., self.angle_dims]
            change[..., self.angle_dims] = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
        if self.quaternion_dims:
            q, q_next = obs[..., self.quaternion_dims], next_obs[..., self.quaternion_dims]
            nearer = torch.where((q * q_next).sum(dim=-1, keepdim=True) < 0.0, -q_next, q_next)
            change[..., self.quaternion_dims] = nearer - q
        return change

    def inputs(self, obs: Tensor) -> Tensor:
        """As :meth:`features` with less copying, for :meth:`weights_for_inputs`.

        All of the observation goes in as it is, and all 16 products of a quaternion instead of the 10 that differ.
        """
        parts = [obs]
        if self.angle_dims:
            angles = _take(obs, self.angle_dims)
            parts += [angles.sin(), angles.cos()]
        if self.quaternion_dims:
            q = _take(obs, self.quaternion_dims)
            parts.append((q[..., None] * q[..., None, :]).flatten(-2))
        return torch.cat(parts, dim=-1) if len(parts) > 1 else obs

    def weights_for_inputs(self, weight: Tensor) -> Tensor:
        """First-layer weights for :meth:`inputs` from those for :meth:`features`, (B, n_features, out).

        What enters otherwise or not at all has weights of 0.
        """
        other = self.other_dims
        from_other, angles, products = weight.tensor_split([len(other), len(other) + 2 * len(self.angle_dims)], dim=1)
        plain = weight.new_zeros(len(weight), self.obs_dim, weight.shape[2])
        plain[:, other] = from_other
        square = weight.new_zeros(len(weight), len(self.quaternion_dims) ** 2, weight.shape[2])
        square[:, [4 * i + j for i, j in self.quaternion_pairs]] = products
        return torch.cat([plain, angles, square], dim=1)


def _take(values: Tensor, dims: tuple[int, ...]) -> Tensor:
    """Some of the last dimensions; a view where they follow each other."""
    if dims == tuple(range(dims[0], dims[-1] + 1)):
        return values[..., dims[0] : dims[-1] + 1]
    return values[..., list(dims)]
