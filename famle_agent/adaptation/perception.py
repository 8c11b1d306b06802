"""Algorithm 2 on robots whose sensors may fail: what cannot be a measurement is neither learnt nor planned from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from famle_agent.adaptation.controller import Controller
from famle_agent.adaptation.senses import Senses, Sensors
from famle_agent.adaptation.state import OnlineState
from famle_agent.utils.deadline import Deadline
from famle_agent.utils.errors import SensorError

__all__ = ["Perception", "Safety", "senses_of"]


@dataclass(frozen=True)
class Safety:
    """What an agent does on a robot when something is missing or late.

    Attributes:
        blind_steps: Steps for which it plans from where its model says that the robot is, while no reading can be a
            measurement; 0 plans from measurements alone. None takes the planner's horizon: plans trust the model for as
            long in any case.
        safe_action: What a robot is told after that, in the units of its action space. Empty raises a
            :class:`~famle_agent.utils.errors.SensorError`, but of several robots those without sensors are told to do
            nothing (0, or what is nearest to it) as long as one of them has any, so that the others go on.
        step_budget_ms: Milliseconds that a step's plan and adaptation should take at most, together. Gradient steps for
            which a plan leaves no time are left out first; then the planner ends early, after its first iteration at
            the least. None sets no limit.
    """

    blind_steps: int | None = None
    safe_action: tuple[float, ...] = ()
    step_budget_ms: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "safe_action", tuple(float(value) for value in self.safe_action))
        if not all(map(math.isfinite, self.safe_action)):
            raise ValueError(f"safe_action must be finite numbers, got {list(self.safe_action)}.")
        if self.step_budget_ms == 0.0:
            raise ValueError("step_budget_ms must be above 0; None sets no limit.")


@dataclass(frozen=True)
class Perception:
    """Runs a controller on what robots have measured, and on what its model expects of them in between.

    Attributes:
        controller: Algorithm 2.
        sensors: Say what can be a measurement.
        blind_steps: Steps for which plans begin at an expectation.
        idle: What a robot is told after that, in [-1, 1], (action_dim,).
        patient: Whether that is the user's choice; otherwise it is an error that no robot sees anything.
    """

    controller: Controller
    sensors: Sensors
    blind_steps: int
    idle: Tensor
    patient: bool

    def begin(self, state: OnlineState, reading: Tensor, starts: Tensor) -> OnlineState:
        """Says where robots are that have taken no step since the last reading; arguments as of :meth:`Senses.at`."""
        return replace(state, senses=senses_of(state).at(self.sensors, reading, starts))

    def sense(self, state: OnlineState, reading: Tensor, moved: Tensor) -> tuple[OnlineState, Tensor]:
        """Says where robots are after the step that a state remembers.

        Args:
            state: The state after the last action.
            reading: What the sensors say, (B, obs_dim).
            moved: Which robots have taken a step that counts, (B,).

        Returns:
            The state, and which robots went through a transition whose two ends were measured, (B,).
        """
        before = senses_of(state)
        senses = before.after(self.sensors, reading, moved, lambda: self._expected(state))
        return replace(state, senses=senses), moved & before.measured & senses.measured

    def observe(self, state: OnlineState, transitions: Tensor, deadline: Deadline | None = None) -> OnlineState:
        """Learns from the step that ends where robots are, where it is a transition (B,), by the deadline, if any."""
        return self.controller.observe(state, senses_of(state).obs, ~transitions, deadline)

    def act(
        self, state: OnlineState, starts: Tensor, generator: torch.Generator, deadline: Deadline | None = None
    ) -> tuple[Tensor, OnlineState]:
        """Plans from where robots are; a robot of which that is unknown for too long is told what is safe.

        Raises:
            SensorError: No robot can plan, and the user has named no safe action.
        """
        senses = senses_of(state)
        helpless = ~senses.known | (senses.blind > self.blind_steps)
        if helpless.all() and not self.patient:
            raise SensorError(
                "The observation holds NaN or infinite values, or others that cannot be a measurement, and "
                + self._since(senses)
                + f": {senses.reading.tolist()}. Check the robot's sensors, plan on without them for longer "
                "(blind_steps), or name an action that is safe (safe_action)."
            )
        action, state = self.controller.act(state, senses.obs, starts, generator, deadline)
        if not helpless.any():
            return action, state
        action = torch.where(helpless[:, None], self.idle, action)
        return action, replace(state, last=(senses.obs, action))

    def _since(self, senses: Senses) -> str:
        if not senses.known.any():
            return "there was no other since the robot began"
        return f"so did the last {int(senses.blind.max())}, with blind_steps={self.blind_steps}"

    def _expected(self, state: OnlineState) -> Tensor:
        """Predicts where the last action led, (B, obs_dim), a mean over the ensemble; angles are not wrapped."""
        if state.last is None:
            return senses_of(state).obs
        obs, action = state.last
        model = self.controller.adapter.model_for(state.belief, state.memory)
        return model(obs[:, None], action[:, None]).mean(dim=1)[:, 0]


def senses_of(state: OnlineState) -> Senses:
    """Returns what the sensors of a state's robots have said; nothing where nobody has asked."""
    if state.senses is not None:
        return state.senses
    return Senses.none(state.robots, state.memory.obs.shape[2], state.plan.device)
