"""The paper's rivals of FAMLE, made of the same parts but without embeddings: AMPC and AMPC-MAML."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from famle_agent.adaptation.adapters import GradientAdapter
from famle_agent.adaptation.controller import OnlineState
from famle_agent.agents.agent import ModelBasedAgent
from famle_agent.models.dynamics import Dynamics
from famle_agent.training.maml import MAML
from famle_agent.training.reptile import Reptile

__all__ = ["AMPC", "AMPCMAML"]

_EVERY_SITUATION = "every situation"


class _OneModelAgent(ModelBasedAgent):
    """An agent that does not tell situations apart: its model has one embedding, which never changes."""

    implied: ClassVar[Mapping[str, Any]] = {
        "embedding_dim": 1,
        "embedding_lr": 0.0,
        "adapt_embedding_lr": 0.0,
        "joint_embedding_lr": 0.0,
        "gate_actions": False,
        "interaction_rank": 0,
        "compose": False,
        "hazard": 0.0,
        "spread_members": False,
    }

    @property
    def _n_embeddings(self) -> int:
        return 1

    def posterior(self, state: OnlineState | None = None) -> dict[str, float]:
        """All the probability on the one model that there is."""
        _ = self.model  # which an agent without one refuses
        return {_EVERY_SITUATION: 1.0}

    def marginals(self, state: OnlineState | None = None) -> dict[str, float]:
        """As :meth:`posterior`."""
        return self.posterior(state)

    def _new_adapter(self, model: Dynamics) -> GradientAdapter:
        return GradientAdapter(model, self.hyperparameters.on_the_robot(), self.seed or 0)


class AMPC(_OneModelAgent):
    """Adaptive MPC: a model that is learnt on the robot from scratch, and planned with from the first step on.

    Every K steps it takes k gradient steps on what the robot has gone through so far, each time from where it is. All
    that it has from simulation is the scale of its inputs and outputs, which :meth:`meta_learn` measures (and the
    reward where that is not known). Arguments as for :class:`~famle_agent.agents.algorithm.ModelBasedAlgorithm`.

    Example:
        >>> from famle_agent import AMPC
        >>> agent = AMPC("reacher", seed=0, transitions_per_situation=50).meta_learn()
        >>> agent.posterior()
        {'every situation': 1.0}
    """

    implied: ClassVar[Mapping[str, Any]] = {
        **_OneModelAgent.implied,
        "rounds": 0,
        "joint_iterations": 0,
        "meta_iterations": 0,
        "keep_adapting": True,
    }

    def _method(self, overrides: Mapping[str, Any]) -> str:
        return "ampc"

    def _meta_learner(self) -> None:
        """Returns nothing: the network keeps its random weights."""


class AMPCMAML(_OneModelAgent):
    """Adaptive MPC whose model was meta-learned, as one starting point for all situations.

    Every K steps it takes k gradient steps on the last M transitions, each time from the meta-learned theta (the
    paper's) or, with the setting ``keep_adapting``, from where the last ones led. The setting ``meta_learner`` says how
    theta is learnt: ``"reptile"`` (Nichol et al., 2018; Algorithm 1 without embeddings), ``"first-order-maml"`` or
    ``"maml"`` (Finn et al., 2017; the paper's eq. 3 to 5). Arguments as for
    :class:`~famle_agent.agents.algorithm.ModelBasedAlgorithm`.

    Example:
        >>> from famle_agent import AMPCMAML
        >>> agent = AMPCMAML("reacher", meta_learner="maml", seed=0, meta_iterations=2, transitions_per_situation=200)
        >>> agent.meta_learn().posterior()
        {'every situation': 1.0}
    """

    def _method(self, overrides: Mapping[str, Any]) -> str:
        return str(overrides.get("meta_learner", "reptile"))

    def _meta_learner(self) -> Reptile | MAML:
        """Returns Reptile or MAML."""
        settings = self.hyperparameters
        return settings.reptile() if settings.meta_learner == "reptile" else settings.maml()
