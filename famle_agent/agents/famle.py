"""FAMLE: Fast Adaptation through Meta-Learning Embeddings (Kaushik, Anne and Mouret, IROS 2020)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from famle_agent.adaptation.adapters import EmbeddingAdapter
from famle_agent.adaptation.belief import Candidates
from famle_agent.adaptation.controller import OnlineState
from famle_agent.agents.agent import ModelBasedAgent
from famle_agent.agents.tensorboard import log_embeddings
from famle_agent.models.dynamics import Dynamics
from famle_agent.training.reptile import Reptile

__all__ = ["FAMLE"]


class FAMLE(ModelBasedAgent):
    """Meta-learns one network and one embedding per situation in simulation; picks and adapts them on the robot.

    Arguments as for :class:`~famle_agent.agents.algorithm.ModelBasedAlgorithm`.

    Example:
        >>> from famle_agent import FAMLE
        >>> agent = FAMLE("reacher", seed=0, meta_iterations=2, transitions_per_situation=50)
        >>> agent = agent.meta_learn()
        >>> agent.situations[:2]
        ('intact', 'joint 0 dead')
    """

    @property
    def _n_embeddings(self) -> int:
        return len(self.situations)

    def _method(self, overrides: Mapping[str, Any]) -> str:
        if overrides.get("meta_learner", "reptile") != "reptile":
            raise ValueError("FAMLE meta-learns with Reptile; a meta_learner is for AMPCMAML, which has no embeddings.")
        return ""

    def _meta_learner(self) -> Reptile:
        """Returns Algorithm 1: Reptile on theta and H."""
        return self.hyperparameters.reptile()

    def _log_model(self) -> None:
        log_embeddings(self.logger, self.model.embeddings[0], self.situations, self.num_timesteps)

    def _new_adapter(self, model: Dynamics) -> EmbeddingAdapter:
        return EmbeddingAdapter(model, self.hyperparameters.on_the_robot(), self.seed or 0)

    @property
    def candidates(self) -> Candidates:
        """The embeddings that the agent selects from.

        Raises:
            NotLearnedError: The agent has no model yet.
        """
        return cast(EmbeddingAdapter, self.adapter).candidates

    def posterior(self, state: OnlineState | None = None) -> dict[str, float]:
        """P(situation | memory) by name, of the first robot; of what the agent believes now, or of a state.

        Where faults are composed, ``"a + b"`` is the situation with both.
        """
        belief = self.belief if state is None else state.belief
        names = self.candidates.names(self.situations)
        return dict(zip(names, belief.posterior[0].tolist(), strict=True))

    def marginals(self, state: OnlineState | None = None) -> dict[str, float]:
        """As :meth:`posterior`, but of each training situation, be it alone or a part of what is wrong."""
        belief = self.belief if state is None else state.belief
        marginal = self.candidates.marginal(belief.posterior)
        return dict(zip(self.situations, marginal[0].tolist(), strict=True))
