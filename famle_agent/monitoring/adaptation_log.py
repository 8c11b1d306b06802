"""What TensorBoard shows of a robot while it lives: what its agent believes, how well it predicts, and what that takes.

It is written within an episode, at an adaptation. It shows the first robot; counts are of all robots together.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
import torch
from stable_baselines3.common.logger import Logger
from torch import Tensor

from famle_agent.adaptation.experience import Experience
from famle_agent.adaptation.perception import senses_of
from famle_agent.adaptation.state import OnlineState
from famle_agent.monitoring.held_out import HeldOut, LoggedStep, Models
from famle_agent.monitoring.logged_agent import LoggedAgent
from famle_agent.monitoring.pictures import Array, PredictedPath, draw_paths, draw_posterior, liveliest
from famle_agent.monitoring.tensorboard import log_embeddings, log_settings, log_values, picture, scalar, shows, text
from famle_agent.utils.allowance import Allowance

__all__ = ["AdaptationLog", "belief_scalars", "log_belief"]

_ENTRIES = 5  # from pictures to pictures
_STEPS = 10  # between two entries of an agent that never adapts while an episode lasts
_MOMENTS = 1000  # of the picture of the posterior
_PATHS = 20  # of the picture of what was predicted
_METRICS = ("episode/return_so_far", "prediction/error_after", "rollout/ep_rew_mean")


class AdaptationLog:
    """Writes to TensorBoard what an agent goes through on its robots, at each adaptation as long as that costs little.

    Entries come as rarely as it takes for them to keep to their share of the time; every fifth has pictures. Errors of
    predictions are those of transitions that came after the last entry and that no adaptation had seen.

    Args:
        agent: A meta-learned agent.
        logger: Where to; without a TensorBoard folder nothing happens.
        steps: Of all robots, that have been logged before.
        share: Of the time that entries may take; 1 writes at each adaptation.
        clock: Gives the time in s.

    Raises:
        NotLearnedError: The agent has no model yet.
    """

    def __init__(
        self,
        agent: LoggedAgent,
        logger: Logger,
        steps: int = 0,
        share: float = 0.01,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._agent, self._logger, self._steps, self._shown = agent, logger, steps, shows(logger)
        self._allowance, self._entries, self._drawn_at = Allowance(share, clock), 0, steps
        self._newest: Experience | None = None
        self._unlogged = list[LoggedStep]()
        self._models: Models | None = None
        self._rewards, self._return, self._diagnosis = list[float](), 0.0, ""
        self._posteriors: deque[tuple[int, Tensor]] = deque(maxlen=_MOMENTS)
        self._paths: deque[PredictedPath] = deque(maxlen=_PATHS)
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
        if self._newest is not None and self._unlogged:
            self._write_numbers(self._newest)
        if self._posteriors and self._drawn_at < self._steps:
            self._write_pictures()

    def _begin_run(self) -> None:
        agent, model, config = self._agent, self._agent.policy.model, self._agent.policy.config
        settings = {"agent": type(agent).__name__, "mode": agent.mode, "seed": agent.seed, **config.to_dict()}
        log_settings(self._logger, settings, _METRICS, self._steps)
        if model.n_situations > 1:
            log_embeddings(self._logger, model.embeddings[0], agent.situations, self._steps)

    def _notice(self, newest: Experience, obs: Tensor, action: Tensor) -> None:
        policy = self._agent.policy
        self._newest, self._models = newest, self._models or Models.of(policy, newest.before)
        self._unlogged.append(LoggedStep.of(newest, obs, action))
        self._posteriors.append((self._steps, newest.after.belief.log_posterior[0]))
        due = newest.adapted if policy.config.adaptation.every else len(self._unlogged) >= _STEPS
        if due and self._allowance.is_left():
            with self._allowance.spending():
                self._write_numbers(newest)
                self._entries += 1
                if self._entries % _ENTRIES == 0:
                    self._write_pictures()

    @torch.no_grad()
    def _write_numbers(self, newest: Experience) -> None:
        agent, policy = self._agent, self._agent.policy
        numbers = {**belief_scalars(agent, newest.after), **_milliseconds(self._unlogged)}
        numbers["step/reward"] = float(np.mean(self._rewards))
        numbers["episode/return_so_far"] = self._return
        if self._models is not None:
            held_out = HeldOut.of(self._unlogged)
            numbers |= self._models.errors(policy.model, held_out)
            if path := self._models.path(held_out, policy.config.planner.horizon, self._steps):
                self._paths.append(path)
            if newest.adapted:
                self._models = self._models.adapted(policy, newest)
        values = [scalar(tag, value) for tag, value in numbers.items()]
        if (diagnosis := str(agent.diagnose(newest.after))) != self._diagnosis:
            self._diagnosis = diagnosis
            values.append(text("diagnosis", diagnosis))
        log_values(self._logger, values, self._steps)
        self._unlogged, self._rewards = [], []

    def _write_pictures(self) -> None:
        agent, (steps, logits) = self._agent, zip(*self._posteriors, strict=True)
        posterior = torch.stack(logits).softmax(dim=1).cpu().numpy()  # (T, C)
        drawn = [picture("posterior", draw_posterior(posterior, list(agent.posterior()), steps[0], steps[-1]))]
        if paths := list(self._paths):
            dims = liveliest(paths, agent.policy.model.target_std.cpu().numpy())
            drawn.append(picture("prediction/path", draw_paths(paths, dims)))
        log_values(self._logger, drawn, self._steps)
        self._drawn_at = self._steps


def log_belief(agent: LoggedAgent, logger: Logger, state: OnlineState) -> None:
    """Records what an agent believes of its robots, the posterior for TensorBoard alone since it is of many situations.

    Arguments as of :func:`belief_scalars`.
    """
    posterior = agent.posterior(state)
    logger.record("adapt/situation", max(posterior, key=lambda name: posterior[name]), exclude="tensorboard")
    for tag, value in belief_scalars(agent, state).items():
        others = ("stdout", "log", "json", "csv") if tag.startswith("posterior/") else None
        logger.record(tag, value, exclude=others)


def belief_scalars(agent: LoggedAgent, state: OnlineState) -> dict[str, float]:
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
        "adapt/recognised": int(state.belief.recognised.sum()),
        **counts,
        "health/overruns": agent.overruns,
        "health/cut_short": agent.cut_short,
        "health/left_out": agent.left_out,
    }


def _milliseconds(steps: Sequence[LoggedStep]) -> dict[str, float]:
    """Means of what plans and adaptations have taken, where there were any."""
    taken = {
        name: [ms for step in steps if (ms := getattr(step, name)) is not None] for name in ("plan_ms", "adapt_ms")
    }
    return {f"time/{name}": float(np.mean(values)) for name, values in taken.items() if values}
