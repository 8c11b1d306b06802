"""What TensorBoard shows of a robot while it lives: what its agent believes, how well it predicts, and what that takes.

It is written within an episode, at an adaptation. It shows the first robot; counts are of all robots together.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from stable_baselines3.common.logger import Logger
from torch import Tensor

from famle_agent.adaptation.controller import OnlineState
from famle_agent.adaptation.perception import senses_of
from famle_agent.agents.pictures import Array, Path, draw_paths, draw_posterior, liveliest
from famle_agent.agents.tensorboard import log_embeddings, log_settings, log_values, picture, scalar, shows, text
from famle_agent.models.dynamics import Dynamics
from famle_agent.models.simulator import Simulator
from famle_agent.utils.allowance import Allowance

if TYPE_CHECKING:
    from famle_agent.agents.agent import ModelBasedAgent

__all__ = ["AdaptationLog", "Experience", "belief_scalars"]

_SHARE = 0.01  # of the time, for numbers and for pictures each
_STEPS = 10  # between two entries of an agent that never adapts while an episode lasts
_MOMENTS = 1000  # of the picture of the posterior
_PATHS = 20  # of the picture of what was predicted
_METRICS = ("episode/return_so_far", "prediction/error_after", "rollout/ep_rew_mean")


@dataclass(frozen=True)
class Experience:
    """Records the newest step of B robots.

    Attributes:
        before: What the agent believed when it had taken place.
        after: What it believes since it learnt from it.
        transitions: Which robots went through a transition that can be learnt from, (B,).
        plan_ms: Milliseconds that the plan took; None where somebody else has acted.
        adapt_ms: Those that learning from it took.
    """

    before: OnlineState
    after: OnlineState
    transitions: Tensor
    plan_ms: float | None
    adapt_ms: float

    @property
    def adapted(self) -> bool:
        """Whether the robots have adapted in this step."""
        return self.after.belief.adaptations > self.before.belief.adaptations


class AdaptationLog:
    """Writes to TensorBoard what an agent goes through on its robots, at each adaptation as long as that costs little.

    Numbers and pictures may take 1 % of the time each: they come as rarely as that takes. Errors of predictions are
    those of transitions that came after the last entry and that no adaptation had seen.

    Args:
        agent: A meta-learned agent.
        logger: Where to; without a TensorBoard folder nothing happens.
        steps: Of all robots, that have been logged before.
        clock: Gives the time in s.

    Raises:
        NotLearnedError: The agent has no model yet.
    """

    def __init__(
        self,
        agent: ModelBasedAgent,
        logger: Logger,
        steps: int = 0,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._agent, self._logger, self._steps, self._shown = agent, logger, steps, shows(logger)
        self._numbers, self._pictures = Allowance(_SHARE, clock), Allowance(_SHARE, clock)
        self._newest: Experience | None = None
        self._window = list[_Step]()
        self._models: _Models | None = None
        self._rewards, self._return, self._diagnosis = list[float](), 0.0, ""
        self._posteriors: deque[tuple[int, Tensor]] = deque(maxlen=_MOMENTS)
        self._paths: deque[Path] = deque(maxlen=_PATHS)
        if self._shown and not steps:
            self._begin_run()

    def step(
        self, experience: Experience | None, rewards: Sequence[float] | Array, dones: Sequence[bool] | Array
    ) -> None:
        """Takes note of a step of the robots, and writes where that is due.

        Args:
            experience: What the agent made of it; None where it was shown nothing.
            rewards: (B,).
            dones: Whose episode ended, (B,).
        """
        if not self._shown:
            return
        self._steps += len(rewards)
        self._rewards.append(float(rewards[0]))
        self._return += float(rewards[0])
        if experience is not None and experience.before.last is not None:
            self._notice(experience, *experience.before.last)
        if dones[0]:
            self._return = 0.0

    def close(self) -> None:
        """Writes what has come since the last time."""
        if self._newest is not None and self._window:
            self._write_numbers(self._newest)
            self._write_pictures()

    def _begin_run(self) -> None:
        agent, model = self._agent, self._agent.model
        settings = {"agent": type(agent).__name__, "mode": agent.mode, "seed": agent.seed, **agent.config.to_dict()}
        log_settings(self._logger, settings, _METRICS, self._steps)
        if model.n_situations > 1:
            log_embeddings(self._logger, model.embeddings[0], agent.situations, self._steps)

    def _notice(self, newest: Experience, obs: Tensor, action: Tensor) -> None:
        self._newest, self._models = newest, self._models or _Models.of(self._agent, newest.before)
        next_obs, adapt_ms = senses_of(newest.before).obs, newest.adapt_ms if newest.adapted else None
        self._window.append(_Step(obs, action, next_obs, newest.transitions, newest.plan_ms, adapt_ms))
        self._posteriors.append((self._steps, newest.after.belief.log_posterior[0]))
        due = newest.adapted if self._agent.config.adaptation.every else len(self._window) >= _STEPS
        if due and self._numbers.is_left():
            with self._numbers.spending():
                self._write_numbers(newest)
            if self._pictures.is_left():
                with self._pictures.spending():
                    self._write_pictures()

    @torch.no_grad()
    def _write_numbers(self, newest: Experience) -> None:
        agent = self._agent
        numbers = {**belief_scalars(agent, newest.after), **_milliseconds(self._window)}
        numbers["step/reward"] = float(np.mean(self._rewards))
        numbers["episode/return_so_far"] = self._return
        if self._models is not None:
            window = _Window.of(self._window)
            numbers |= self._models.errors(agent.model, window)
            if path := self._models.path(window, agent.config.planner.horizon, self._steps):
                self._paths.append(path)
            if newest.adapted:
                self._models = self._models.adapted(agent, newest)
        values = [scalar(tag, value) for tag, value in numbers.items()]
        if (diagnosis := str(agent.diagnose(newest.after))) != self._diagnosis:
            self._diagnosis = diagnosis
            values.append(text("diagnosis", diagnosis))
        log_values(self._logger, values, self._steps)
        self._window, self._rewards = [], []

    def _write_pictures(self) -> None:
        agent, (steps, logits) = self._agent, zip(*self._posteriors, strict=True)
        posterior = torch.stack(logits).softmax(dim=1).cpu().numpy()  # (T, C)
        drawn = [picture("posterior", draw_posterior(posterior, list(agent.posterior()), steps[0], steps[-1]))]
        if paths := list(self._paths):
            dims = liveliest(paths, agent.model.target_std.cpu().numpy())
            drawn.append(picture("prediction/path", draw_paths(paths, dims)))
        log_values(self._logger, drawn, self._steps)


def belief_scalars(agent: ModelBasedAgent, state: OnlineState) -> dict[str, float]:
    """Returns how likely each situation is, how often robots adapted, and what was missing or late, by tag.

    Args:
        agent: Whose belief that is.
        state: Of its robots. The posterior is the first robot's, the counts are of all of them.
    """
    posterior = {f"posterior/{name}": value for name, value in agent.marginals(state).items()}
    counts = {f"health/{name}": int(count.sum()) for name, count in senses_of(state).counts.items()}
    return {
        **posterior,
        "adapt/adaptations": state.belief.adaptations,
        "adapt/diverged": int(state.belief.diverged.sum()),
        **counts,
        "health/overruns": agent.overruns,
        "health/cut_short": agent.cut_short,
    }


@dataclass(frozen=True)
class _Step:
    """What an entry needs of a step of B robots, whose memories would be too much to keep."""

    obs: Tensor
    action: Tensor
    next_obs: Tensor
    valid: Tensor
    plan_ms: float | None
    adapt_ms: float | None  # None where nothing was adapted


@dataclass(frozen=True)
class _Window:
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
    def of(cls, steps: Sequence[_Step]) -> _Window:
        """Puts steps side by side."""
        names = ("obs", "action", "next_obs", "valid")
        return cls(*(torch.stack([getattr(step, name) for step in steps], dim=1) for name in names))

    def unbroken(self) -> int:
        """Counts the steps of the first robot before something other than a transition comes between them."""
        follows = self.valid[0].clone()
        follows[1:] &= (self.obs[0, 1:] == self.next_obs[0, :-1]).all(dim=1)
        return int(follows.long().cumprod(dim=0).sum())


@dataclass(frozen=True)
class _Models:
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
    def of(cls, agent: ModelBasedAgent, known: OnlineState) -> _Models:
        """Takes what the robots have before their first step."""
        new = agent.policy.initial(known.robots)
        begins = agent.adapter.model_for(known.belief, known.memory)
        return cls(agent.adapter.model_for(new.belief, new.memory), begins, begins)

    def adapted(self, agent: ModelBasedAgent, newest: Experience) -> _Models:
        """Takes what they had before an adaptation, and after it."""
        states = newest.before, newest.after
        return _Models(self.unadapted, *(agent.adapter.model_for(state.belief, state.memory) for state in states))

    def errors(self, model: Dynamics, window: _Window) -> dict[str, float]:
        """Compares their errors on transitions that none of them has been adapted to, in those of simulation."""
        if not window.valid.any():
            return {}
        return {f"prediction/error_{name}": _error(model, one, window) for name, one in vars(self).items()}

    def path(self, window: _Window, horizon: int, last: int) -> Path | None:
        """Predicts where the first robot's actions lead, at most as far as the planner looks; None without any step."""
        if not (n := min(window.unbroken(), horizon)):
            return None
        predicted = [window.obs[:, None, :1].expand(-1, self.after.members, -1, -1)]  # (B, P, 1, obs_dim)
        for action in window.action[:, :n].unbind(dim=1):
            predicted.append(self.after(predicted[-1], action[:, None]))
        real = torch.cat([window.obs[0, :1], window.next_obs[0, :n]])
        robots, steps = window.valid.shape
        mean = torch.cat(predicted, dim=2)[0].mean(dim=0)
        return Path(last - robots * steps, real.cpu().numpy(), mean.cpu().numpy())


def _error(model: Dynamics, simulator: Simulator, window: _Window) -> float:
    """Computes the root mean square of the errors of the next observation, in those of simulation."""
    obs, noise = window.obs[:, None], model.noise_std[: model.members, None]  # (B, 1, n, obs_dim), (P, 1, obs_dim)
    predicted = model.layout.change(obs, simulator(window.obs, window.action))  # (B, P, n, obs_dim)
    off = (predicted - model.layout.change(obs, window.next_obs[:, None])) / (model.target_std * noise)
    mean_square = off.square().mean(dim=(1, 3))[window.valid].mean()
    return float(mean_square.sqrt() / model.usual_error)


def _milliseconds(steps: Sequence[_Step]) -> dict[str, float]:
    """Means of what plans and adaptations have taken, where there were any."""
    taken = {
        name: [ms for step in steps if (ms := getattr(step, name)) is not None] for name in ("plan_ms", "adapt_ms")
    }
    return {f"time/{name}": float(np.mean(values)) for name, values in taken.items() if values}
