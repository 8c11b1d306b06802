"""FAMLE: Fast Adaptation through Meta-Learning Embeddings (Kaushik, Anne and Mouret, IROS 2020)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, cast

from famle_agent.adaptation.adapters import EmbeddingAdapter
from famle_agent.adaptation.candidates import Candidates
from famle_agent.agents.agent import ModelBasedAgent

__all__ = ["FAMLE"]


class FAMLE(ModelBasedAgent):
    """Meta-learns one network and one embedding per situation in simulation; picks and adapts them on the robot.

    Arguments as for :class:`~famle_agent.agents.agent.ModelBasedAgent`.

    Example:
        >>> from famle_agent import FAMLE
        >>> agent = FAMLE("reacher", seed=0, meta_iterations=2, transitions_per_situation=50)
        >>> agent = agent.meta_learn()
        >>> agent.situations[:2]
        ('intact', 'joint 0 dead')
    """

    implied: ClassVar[Mapping[str, Any]] = {"meta_learner": "reptile"}  # MAML has no embeddings
    adapter_class = EmbeddingAdapter

    @property
    def candidates(self) -> Candidates:
        """The embeddings that the agent selects from.

        Raises:
            NotLearnedError: The agent has no model yet.
        """
        return cast(EmbeddingAdapter, self.adapter).candidates
