"""Robots that adapt to damage: FAMLE, its rivals, its wrapper and what they are made of.

Names are imported when they are first used, so that the command line answers before PyTorch is there.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from famle_agent.agent import ModelBasedAgent
    from famle_agent.baselines import AMPC, AMPCMAML
    from famle_agent.controller import OnlineState
    from famle_agent.errors import NotLearnedError
    from famle_agent.famle import FAMLE
    from famle_agent.hyperparameters import Hyperparameters
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
    "__version__",
]

__version__ = version("famle")

_MODULES = {
    "AMPC": "baselines",
    "AMPCMAML": "baselines",
    "FAMLE": "famle",
    "FAMLEWrapper": "wrapper",
    "Hyperparameters": "hyperparameters",
    "ModelBasedAgent": "agent",
    "NotLearnedError": "errors",
    "OnlineState": "controller",
    "Transitions": "transitions",
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
