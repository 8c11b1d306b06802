"""What the numbers of an observation are, and so what a model should see of them and what it should predict."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import torch
from torch import Tensor

__all__ = ["DIMS", "ObservationLayout"]

DIMS = ("angle_dims", "quaternion_dims", "pose_dims")
"""What an environment may say about its observation, by the names of its attributes."""


@dataclass(frozen=True)
class ObservationLayout:
    """The observation dimensions that are more than plain numbers.

    Angles enter a model as sine and cosine, and their change is taken the short way round, so that a jump from pi to
    -pi is no event. A quaternion q enters as the products q_i q_j, in which a rotation is linear and q and -q are
    the same. A pose on the floor does not enter at all, and its change is seen from the robot, along its own heading: a
    robot moves alike wherever it stands and looks.

    Attributes:
        obs_dim: Number of observation dimensions.
        angle_dims: Those that are angles in rad.
        quaternion_dims: The four of a unit quaternion, or none.
        pose_dims: x, y and heading of a robot on a floor, the heading as an angle in rad or as its sine and its cosine;
            three dimensions, four, or none.

    Raises:
        ValueError: The dimensions are of another number, name one twice, or do not exist.
    """

    obs_dim: int
    angle_dims: tuple[int, ...] = ()
    quaternion_dims: tuple[int, ...] = ()
    pose_dims: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for name, sizes in (("quaternion_dims", (0, 4)), ("pose_dims", (0, 3, 4))):
            if len(getattr(self, name)) not in sizes:
                wanted = " or ".join(str(size) for size in sizes[1:])
                raise ValueError(f"{name} must name {wanted} dimensions or none, got {getattr(self, name)}.")
        dims = [*self.angle_dims, *self.quaternion_dims, *self.pose_dims]
        if len(set(dims)) < len(dims):
            raise ValueError(f"{', '.join(DIMS)} name a dimension twice: {dims}.")
        if any(not 0 <= dim < self.obs_dim for dim in dims):
            raise ValueError(
                f"{', '.join(DIMS)} name dimensions that an observation of {self.obs_dim} has not: {dims}."
            )

    @cached_property
    def other_dims(self) -> list[int]:
        """Dimensions that enter as they are."""
        special = {*self.angle_dims, *self.quaternion_dims, *self.pose_dims}
        return [dim for dim in range(self.obs_dim) if dim not in special]

    @cached_property
    def quaternion_pairs(self) -> list[tuple[int, int]]:
        """The pairs (i, j) of the products q_i q_j that differ."""
        return list(combinations_with_replacement(range(len(self.quaternion_dims)), 2))

    @cached_property
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
        """What a model predicts, (..., obs_dim): how each number changes, all angles the short way round."""
        change = next_obs - obs
        angles = [*self.angle_dims, *self.pose_dims[2:]] if len(self.pose_dims) == 3 else list(self.angle_dims)
        if angles:
            change[..., angles] = torch.remainder(change[..., angles] + math.pi, 2 * math.pi) - math.pi
        if self.quaternion_dims:
            q, q_next = obs[..., self.quaternion_dims], next_obs[..., self.quaternion_dims]
            nearer = torch.where((q * q_next).sum(dim=-1, keepdim=True) < 0.0, -q_next, q_next)
            change[..., self.quaternion_dims] = nearer - q
        if self.pose_dims:
            (x, y), (sine, cosine) = self.pose_dims[:2], self._heading(obs)
            dx, dy = change[..., x], change[..., y]
            change[..., x], change[..., y] = cosine * dx + sine * dy, cosine * dy - sine * dx
            if len(self.pose_dims) == 4:
                s, c = self.pose_dims[2:]
                next_sine, next_cosine = self._heading(next_obs)
                change[..., s] = next_sine * cosine - next_cosine * sine
                change[..., c] = next_cosine * cosine + next_sine * sine - 1.0
        return change

    def advance(self, obs: Tensor, change: Tensor) -> Tensor:
        """The next observations from a :meth:`change`; angles are not wrapped. ``change`` is used up."""
        if not self.pose_dims:
            return change.add_(obs) if not change.requires_grad else change + obs
        (x, y), (sine, cosine) = self.pose_dims[:2], self._heading(obs)
        ahead, aside = change[..., x], change[..., y]
        next_obs = obs + change
        next_obs[..., x] = obs[..., x] + cosine * ahead - sine * aside
        next_obs[..., y] = obs[..., y] + sine * ahead + cosine * aside
        if len(self.pose_dims) == 4:
            s, c = self.pose_dims[2:]
            turned_sine, turned_cosine = change[..., s], change[..., c] + 1.0
            turned = torch.stack(
                [sine * turned_cosine + cosine * turned_sine, cosine * turned_cosine - sine * turned_sine], dim=-1
            )
            next_obs[..., [s, c]] = turned / turned.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        return next_obs

    def _heading(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Sine and cosine of the robot's heading, (...)."""
        if len(self.pose_dims) == 4:
            return obs[..., self.pose_dims[2]], obs[..., self.pose_dims[3]]
        heading = obs[..., self.pose_dims[2]]
        return heading.sin(), heading.cos()
