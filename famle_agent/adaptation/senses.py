"""Which readings of a robot's sensors can be measurements, and where a robot is as long as none can.

What Algorithm 2 takes for s and s' comes from here; :mod:`~famle_agent.adaptation.perception` puts the two together.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from gymnasium import spaces
from torch import Tensor

from famle_agent.models.dynamics import Dynamics

__all__ = ["Senses", "Sensors"]

_IMPOSSIBLE_STATE = 1e4  # deviations of what a model was trained on, beyond which its numbers mean nothing
_IMPOSSIBLE_CHANGE = 100.0  # deviations of the change in one step; those of an ant whose yaw sensor turns reach 67


@dataclass(frozen=True)
class Sensors:
    """Tells what cannot be a measurement from what only surprises.

    A sensor that is off, frozen, late or noisy within what its robot can reach is no business of this class: it is a
    situation, of which models are learnt and to which agents adapt. What no robot of this kind can measure is a number
    that is not finite, that lies beyond the bounds of the observation space by more than their distance, that is ten
    thousand deviations away from all that was simulated, or that a step has changed by a hundred deviations of what a
    step changes.

    Attributes:
        model: Its normalisation knows what was simulated.
        low: The least that an observed number may be, (obs_dim,).
        high: The most, (obs_dim,).
    """

    model: Dynamics
    low: Tensor
    high: Tensor

    @classmethod
    def of(cls, model: Dynamics, space: spaces.Box) -> Sensors:
        """Those of robots with a model and a space of observations."""
        low, high = (torch.as_tensor(end, dtype=torch.float64) for end in (space.low, space.high))
        ends = low - (high - low), high + (high - low)  # infinite where one of the bounds is
        return cls(model, *(end.to(model.noise_std) for end in ends))

    def possible(self, reading: Tensor) -> Tensor:
        """Says of each robot whether it can be in a state, (B, obs_dim) -> (B,), wherever it was before."""
        model = self.model
        features = (model.layout.features(reading) - model.input_mean) / model.input_std
        within = (reading >= self.low) & (reading <= self.high) & reading.isfinite()
        return within.all(dim=1) & (features.abs() <= _IMPOSSIBLE_STATE).all(dim=1)

    def follows(self, reading: Tensor, before: Tensor) -> Tensor:
        """Says of each robot whether a step can have led from one state to another, (B, obs_dim) each -> (B,)."""
        model = self.model
        change = (model.layout.change(before, reading) - model.target_mean) / model.target_std
        return (change.abs() <= _IMPOSSIBLE_CHANGE).all(dim=1)


@dataclass(frozen=True)
class Senses:
    """What the sensors of B robots have said last. Immutable.

    Attributes:
        obs: Where each robot is, (B, obs_dim), finite: what was measured last, moved on by the model since then.
        reading: What the sensors said last, whatever that was, (B, obs_dim).
        known: Whether anything was measured since the robot was put where it is, (B,).
        blind: Readings since the last measurement, (B,).
        quarantined: Transitions without a measurement at both ends, which nobody learns from, (B,).
        dropped: Steps that were no transition for another reason: a reset by somebody else, or a failure, (B,).
        repeated: Steps after which every number was that of the step before to the last bit, (B,). A message that comes
            twice looks like that, but so does a robot that does not move: it is counted, and learnt from.
    """

    obs: Tensor
    reading: Tensor
    known: Tensor
    blind: Tensor
    quarantined: Tensor
    dropped: Tensor
    repeated: Tensor

    @classmethod
    def none(cls, robots: int, obs_dim: int, device: torch.device) -> Senses:
        """Those of B robots that nobody has seen."""
        obs = torch.zeros(robots, obs_dim, dtype=torch.float32, device=device)
        zero = torch.zeros(robots, dtype=torch.long, device=device)
        return cls(obs, torch.full_like(obs, math.nan), zero.bool(), zero, zero, zero, zero)

    @property
    def robots(self) -> int:
        """B."""
        return len(self.obs)

    @property
    def measured(self) -> Tensor:
        """Whether ``obs`` was measured, (B,)."""
        return self.known & (self.blind == 0)

    def at(self, sensors: Sensors, reading: Tensor, starts: Tensor) -> Senses:
        """Says where robots are that have taken no step since the last reading.

        Args:
            sensors: Say what can be a measurement.
            reading: What the sensors say, (B, obs_dim). Where it is another than the last one, somebody has moved the
                robot.
            starts: Which robots were just put somewhere else in any case, (B,).
        """
        moved = starts | ~_same(reading, self.reading)
        if not moved.any():
            return self
        known = torch.where(moved, sensors.possible(reading), self.known)
        return replace(
            self,
            obs=torch.where((moved & known)[:, None], reading, self.obs),
            reading=reading,
            known=known,
            blind=torch.where(moved, (~known).long(), self.blind),
        )

    def after(self, sensors: Sensors, reading: Tensor, moved: Tensor, expected: Callable[[], Tensor]) -> Senses:
        """Says where robots are after a step.

        A reading that is too far from where a robot was is not taken, but believed as soon as the next one confirms it:
        the robot, or its sensor, is there to stay.

        Args:
            sensors: Say what can be a measurement.
            reading: What the sensors say, (B, obs_dim).
            moved: Which robots have taken a step, (B,); the others stay where they were.
            expected: Predicts where the step led, (B, obs_dim).
        """
        confirmed = sensors.follows(reading, self.obs) | sensors.follows(reading, self.reading)
        seen = sensors.possible(reading) & (confirmed | ~self.known)
        obs = torch.where(seen[:, None], reading, self.obs)
        if (lost := moved & ~seen & self.known).any():
            predicted = expected()
            usable = lost & sensors.possible(predicted)  # a model that has lost its way says nothing
            obs = torch.where(usable[:, None], predicted, obs)
        new = replace(
            self,
            obs=obs,
            reading=reading,
            known=self.known | seen,
            blind=torch.where(seen, 0, self.blind + 1),
            quarantined=self.quarantined + ~(seen & self.measured),
            repeated=self.repeated + (seen & _same(reading, self.reading)),
        )
        return new.where(moved, self)

    def where(self, kept: Tensor, other: Senses) -> Senses:
        """These senses for the robots in ``kept`` (B,), and the other ones for the rest."""

        def choose(mine: Tensor, theirs: Tensor) -> Tensor:
            return torch.where(kept.view(-1, *[1] * (mine.ndim - 1)), mine, theirs)

        return Senses(**{name: choose(value, getattr(other, name)) for name, value in vars(self).items()})

    def dropping(self, dropped: Tensor) -> Senses:
        """The same, with a step of the robots in ``dropped`` (B,) that was no transition."""
        return replace(self, dropped=self.dropped + dropped)

    @property
    def counts(self) -> dict[str, Tensor]:
        """What was counted of each robot, (B,), by name."""
        return {name: getattr(self, name) for name in ("quarantined", "dropped", "repeated", "blind")}


def _same(a: Tensor, b: Tensor) -> Tensor:
    """Whether two readings (B, obs_dim) are the same, (B,); NaN is the same as NaN."""
    return ((a == b) | (a.isnan() & b.isnan())).all(dim=1)
