"""FAMLE: Fast Adaptation through Meta-Learning Embeddings (Kaushik, Anne and Mouret, IROS 2020)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from famle_agent.adaptation import (
    Belief,
    Candidates,
    better_explained,
    filtered_posterior,
    prior,
    select,
    window_posterior,
)
from famle_agent.agent import ModelBasedAgent
from famle_agent.dashboard import log_embeddings
from famle_agent.memory import Memory
from famle_agent.online import OnlineState
from famle_agent.planning import Model
from famle_agent.simulation import Round
from famle_agent.transitions import Transitions

__all__ = ["FAMLE"]


class FAMLE(ModelBasedAgent):
    """Meta-learns one network and one embedding per situation in simulation; picks and adapts them on the robot.

    Arguments as for :class:`~famle_agent.algorithm.ModelBasedAlgorithm`.

    Example:
        >>> from famle_agent import FAMLE
        >>> agent = FAMLE("reacher", seed=0, meta_iterations=2, transitions_per_situation=50)
        >>> agent = agent.meta_learn()
        >>> agent.situations[:2]
        ('intact', 'joint 0 dead')
    """

    _known: tuple[tuple[Tensor, int, bool], Candidates] | None = None

    @property
    def _n_embeddings(self) -> int:
        return len(self.situations)

    def _method(self, overrides: Mapping[str, Any]) -> str:
        if overrides.get("meta_learner", "reptile") != "reptile":
            raise ValueError("FAMLE meta-learns with Reptile; a meta_learner is for AMPCMAML, which has no embeddings.")
        return ""

    def _learn_model(self, transitions: Transitions, round_: Round) -> None:
        """Joint training in each round, and in the last one Algorithm 1: Reptile on theta and H."""
        model = self._meta_train(transitions, round_, self.hyperparameters.reptile())
        if round_.last:
            log_embeddings(self.logger, model.embeddings[0], self.situations, self.num_timesteps)

    def _candidates(self) -> Candidates:
        model, compose = self._require_dynamics(), self.hyperparameters.compose
        # They are asked for several times a step; a tensor counts the times that it was written to.
        state = model.embeddings, model.embeddings._version, compose
        if self._known is None or self._known[0][0] is not state[0] or self._known[0][1:] != state[1:]:
            self._known = state, Candidates.of(model, compose)
        return self._known[1]

    def posterior(self, state: OnlineState | None = None) -> dict[str, float]:
        """P(situation | memory) by name, of the first robot; of what the agent believes now, or of a state.

        Where faults are composed, ``"a + b"`` is the situation with both.
        """
        belief = self.belief if state is None else state.belief
        names = self._candidates().names(self.situations)
        return dict(zip(names, belief.posterior[0].tolist(), strict=True))

    def marginals(self, state: OnlineState | None = None) -> dict[str, float]:
        """As :meth:`posterior`, but of each training situation, be it alone or a part of what is wrong."""
        belief = self.belief if state is None else state.belief
        marginal = self._candidates().marginal(belief.posterior)
        return dict(zip(self.situations, marginal[0].tolist(), strict=True))

    def _prior(self, robots: int) -> Belief:
        return prior(self._require_dynamics(), self._candidates(), robots)

    def _log_likelihood(self, belief: Belief, obs: Tensor, action: Tensor, next_obs: Tensor) -> tuple[Tensor, Tensor]:
        model, settings = self._require_dynamics(), self.hyperparameters
        transition = model.encode(obs[:, None], action[:, None], next_obs[:, None])
        log_p = settings.likelihood_power * self._candidates().log_likelihood(model, transition)[:, 0]
        if not settings.keep_adapting:
            return log_p, torch.zeros_like(log_p[:, 0])  # nobody asks
        return log_p, settings.likelihood_power * belief.log_likelihood(model, transition)[:, 0]

    def _infer(self, memory: Memory, belief: Belief, moved: Tensor) -> Belief:
        if hazard := self.hyperparameters.hazard:
            new = filtered_posterior(self._candidates(), belief.log_posterior, memory.log_p[:, -1], hazard)
            return replace(belief, log_posterior=torch.where(moved[:, None], new, belief.log_posterior))
        return replace(belief, log_posterior=window_posterior(self._candidates(), memory))

    def _adapt(self, memory: Memory, belief: Belief) -> tuple[Memory, Belief]:
        """Algorithm 2, lines 6 and 7: the most likely embedding, then k gradient steps on theta and h."""
        settings, start = self.hyperparameters, self._selected(belief)
        if settings.keep_adapting:
            changed = better_explained(memory, start.candidate) & (start.candidate != belief.candidate)
            memory = memory.begun_anew(changed, settings.selection_window, start.candidate)
            start = start.where(changed, replace(belief, adaptations=start.adaptations))
        return memory, self._descend(start, memory)

    def _simulator(self, belief: Belief, memory: Memory) -> Model:
        """Where steps go on, they may lead astray for a while: until they are of use, the embedding alone plans."""
        if self.hyperparameters.keep_adapting:
            better = better_explained(memory, belief.log_posterior.argmax(dim=1))
            if better.any():
                belief = replace(self._selected(belief).where(better, belief), adaptations=belief.adaptations)
        return super()._simulator(belief, memory)

    def _selected(self, belief: Belief) -> Belief:
        """Line 6: theta_meta with the most likely embedding."""
        return select(self._require_dynamics(), self._candidates(), belief, self.hyperparameters.spread_members)
