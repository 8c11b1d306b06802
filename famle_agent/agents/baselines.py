"""The paper's rivals of FAMLE, made of the same parts but without embeddings: AMPC and AMPC-MAML."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from famle_agent.adaptation.adapters import GradientAdapter
from famle_agent.agents.agent import ModelBasedAgent

__all__ = ["AMPC", "AMPCMAML"]

_WITHOUT_EMBEDDINGS: Mapping[str, Any] = {
    "policy_steps": 0,
    "embedding_dim": 1,
    "embedding_lr": 0.0,
    "adapt_embedding_lr": 0.0,
    "joint_embedding_lr": 0.0,
    "gate_actions": False,
    "interaction_rank": 0,
    "compose": False,
    "hazard": 0.0,
}


class AMPC(ModelBasedAgent):
    """Adaptive MPC: a model that is learnt on the robot from scratch, and planned with from the first step on.

    Every K steps it takes k gradient steps on what the robot has gone through so far, each time from where it is. All
    that it has from simulation is the scale of its inputs and outputs, which :meth:`meta_learn` measures (and the
    reward where that is not known). Arguments as for :class:`~famle_agent.agents.agent.ModelBasedAgent`.

    Example:
        >>> from famle_agent import AMPC
        >>> agent = AMPC("reacher", seed=0, transitions_per_situation=50).meta_learn()
        >>> agent.posterior()
        {'every situation': 1.0}
    """

    implied: ClassVar[Mapping[str, Any]] = {
        **_WITHOUT_EMBEDDINGS,
        "rounds": 0,
        "joint_iterations": 0,
        "meta_iterations": 0,
        "warm_start": True,
    }
    adapter_class = GradientAdapter

    def _preset(self, overrides: Mapping[str, Any]) -> str:
        return "ampc"


class AMPCMAML(ModelBasedAgent):
    """Adaptive MPC whose model was meta-learned, as one starting point for all situations.

    Every K steps it takes k gradient steps on the last M transitions, each time from the meta-learned theta (the
    paper's) or, with the setting ``warm_start``, from where the last ones led. The setting ``meta_learner`` says how
    theta is learnt: ``"reptile"`` (Nichol et al., 2018; Algorithm 1 without embeddings), ``"first-order-maml"`` or
    ``"maml"`` (Finn et al., 2017; the paper's eq. 3 to 5). Arguments as for
    :class:`~famle_agent.agents.agent.ModelBasedAgent`.

    Example:
        >>> from famle_agent import AMPCMAML
        >>> agent = AMPCMAML("reacher", meta_learner="maml", seed=0, meta_iterations=2, transitions_per_situation=200)
        >>> agent.meta_learn().posterior()
        {'every situation': 1.0}
    """

    implied = _WITHOUT_EMBEDDINGS
    adapter_class = GradientAdapter

    def _preset(self, overrides: Mapping[str, Any]) -> str:
        return str(overrides.get("meta_learner", "reptile"))
