"""How well an agent predicts transitions of its robots that it has not been adapted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from famle_agent.adaptation.experience import Experience
from famle_agent.adaptation.perception import senses_of
from famle_agent.adaptation.state import OnlineState
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.simulator import Simulator
from famle_agent.monitoring.logged_agent import LoggedPolicy
from famle_agent.monitoring.pictures import PredictedPath

__all__ = ["HeldOut", "LoggedStep", "Models"]


@dataclass(frozen=True)
class LoggedStep:
    """Keeps of a step of B robots what does not take the room of their memories.

    Attributes:
        obs: (B, obs_dim).
        action: In [-1, 1], (B, action_dim).
        next_obs: (B, obs_dim).
        valid: Which robots went through a transition, (B,).
        plan_ms: Milliseconds that the plan took; None where somebody else has acted.
        adapt_ms: Those of the adaptation; None where nothing was adapted.
    """

    obs: Tensor
    action: Tensor
    next_obs: Tensor
    valid: Tensor
    plan_ms: float | None
    adapt_ms: float | None

    @classmethod
    def of(cls, experience: Experience, obs: Tensor, action: Tensor) -> LoggedStep:
        """Takes it from an experience that began at ``obs`` with ``action``."""
        next_obs, adapt_ms = senses_of(experience.before).obs, experience.adapt_ms if experience.adapted else None
        return cls(obs, action, next_obs, experience.transitions, experience.plan_ms, adapt_ms)


@dataclass(frozen=True)
class HeldOut:
    """The steps since the last entry, n of each of B robots.

    Attributes:
        obs: (B, n, obs_dim).
        action: In [-1, 1], (B, n, action_dim).
        next_obs: (B, n, obs_dim).
        valid: Which of them are transitions, (B, n).
    """

    obs: Tensor
    action: Tensor
    next_obs: Tensor
    valid: Tensor

    @classmethod
    def of(cls, steps: Sequence[LoggedStep]) -> HeldOut:
        """Puts steps side by side."""
        names = ("obs", "action", "next_obs", "valid")
        return cls(*(torch.stack([getattr(step, name) for step in steps], dim=1) for name in names))

    def unbroken(self) -> int:
        """Counts the steps of the first robot before something other than a transition comes between them."""
        follows = self.valid[0].clone()
        follows[1:] &= (self.obs[0, 1:] == self.next_obs[0, :-1]).all(dim=1)
        return int(follows.long().cumprod(dim=0).sum())


@dataclass(frozen=True)
class Models:
    """What B robots could have predicted with since the last entry.

    Attributes:
        unadapted: What was meta-learned, of a robot that has seen nothing.
        before: As it was before the last adaptation that an entry was written at.
        after: As it was after that.
    """

    unadapted: Simulator
    before: Simulator
    after: Simulator

    @classmethod
    def of(cls, policy: LoggedPolicy, known: OnlineState) -> Models:
        """Takes what the robots have before their first step."""
        new = policy.initial(known.robots)
        begins = policy.adapter.model_for(known.belief, known.memory)
        return cls(policy.adapter.model_for(new.belief, new.memory), begins, begins)

    def adapted(self, policy: LoggedPolicy, newest: Experience) -> Models:
        """Takes what they had before an adaptation, and after it."""
        states = newest.before, newest.after
        return Models(self.unadapted, *(policy.adapter.model_for(state.belief, state.memory) for state in states))

    def errors(self, model: Dynamics, held_out: HeldOut) -> dict[str, float]:
        """Compares their errors on transitions that none of them has been adapted to, in those of simulation."""
        if not held_out.valid.any():
            return {}
        return {f"prediction/error_{name}": _error(model, one, held_out) for name, one in vars(self).items()}

    def path(self, held_out: HeldOut, horizon: int, last: int) -> PredictedPath | None:
        """Predicts where the first robot's actions lead, at most as far as the planner looks; None without any step."""
        if not (n := min(held_out.unbroken(), horizon)):
            return None
        predicted = [held_out.obs[:, None, :1].expand(-1, self.after.members, -1, -1)]  # (B, P, 1, obs_dim)
        for action in held_out.action[:, :n].unbind(dim=1):
            predicted.append(self.after(predicted[-1], action[:, None]))
        real = torch.cat([held_out.obs[0, :1], held_out.next_obs[0, :n]])
        robots, steps = held_out.valid.shape
        mean = torch.cat(predicted, dim=2)[0].mean(dim=0)
        return PredictedPath(last - robots * steps, real.cpu().numpy(), mean.cpu().numpy())


def _error(model: Dynamics, simulator: Simulator, held_out: HeldOut) -> float:
    """Computes the root mean square of the errors of the next observation, in those of simulation."""
    obs, noise = held_out.obs[:, None], model.noise_std[: model.members, None]  # (B, 1, n, obs_dim), (P, 1, obs_dim)
    predicted = model.layout.change(obs, simulator(held_out.obs, held_out.action))  # (B, P, n, obs_dim)
    off = (predicted - model.layout.change(obs, held_out.next_obs[:, None])) / (model.target_std * noise)
    mean_square = off.square().mean(dim=(1, 3))[held_out.valid].mean()
    return float(mean_square.sqrt() / model.usual_error)
