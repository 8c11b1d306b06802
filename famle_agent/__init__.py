"""Robots that adapt to damage: FAMLE, its rivals, its wrapper and what they are made of.

To read the code, begin with Algorithm 2 in :mod:`famle_agent.adaptation.controller`, and with Algorithm 1 in
:mod:`famle_agent.training.trainer`.

Names are imported when they are first used, so that the command line answers before PyTorch is there.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from famle_agent.adaptation.state import OnlineState
    from famle_agent.agents.agent import ModelBasedAgent
    from famle_agent.agents.baselines import AMPC, AMPCMAML
    from famle_agent.agents.config import Config
    from famle_agent.agents.famle import FAMLE
    from famle_agent.agents.wrapper import FAMLEWrapper
    from famle_agent.data.transitions import Transitions
    from famle_agent.data.truncate_on_error import TruncateOnError
    from famle_agent.monitoring.adaptation_log import AdaptationLog
    from famle_agent.utils.errors import NotLearnedError, SensorError

__all__ = [
    "AMPC",
    "AMPCMAML",
    "FAMLE",
    "AdaptationLog",
    "Config",
    "FAMLEWrapper",
    "ModelBasedAgent",
    "NotLearnedError",
    "OnlineState",
    "SensorError",
    "Transitions",
    "TruncateOnError",
    "__version__",
]

__version__ = version("famle")

_MODULES = {
    "AMPC": "agents.baselines",
    "AMPCMAML": "agents.baselines",
    "AdaptationLog": "monitoring.adaptation_log",
    "Config": "agents.config",
    "FAMLE": "agents.famle",
    "FAMLEWrapper": "agents.wrapper",
    "ModelBasedAgent": "agents.agent",
    "Hyperparameters": "agents.config",  # deprecated
    "NotLearnedError": "utils.errors",
    "OnlineState": "adaptation.state",
    "SensorError": "utils.errors",
    "Transitions": "data.transitions",
    "TruncateOnError": "data.truncate_on_error",
}


def __getattr__(name: str) -> Any:
    """Imports a public name."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Lists the public names too, for completion."""
    return sorted({*globals(), *__all__})
