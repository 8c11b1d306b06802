"""Robots that adapt to damage: FAMLE, its rivals, its wrapper and what they are made of."""

from famle_agent.agent import ModelBasedAgent
from famle_agent.baselines import AMPC, AMPCMAML
from famle_agent.errors import NotLearnedError
from famle_agent.famle import FAMLE
from famle_agent.hyperparameters import Hyperparameters
from famle_agent.online import OnlineState
from famle_agent.transitions import Transitions
from famle_agent.wrapper import FAMLEWrapper

__all__ = [
    "AMPC",
    "AMPCMAML",
    "FAMLE",
    "FAMLEWrapper",
    "Hyperparameters",
    "ModelBasedAgent",
    "NotLearnedError",
    "OnlineState",
    "Transitions",
]
