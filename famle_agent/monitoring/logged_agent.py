"""An agent, as far as what is written of it knows it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from famle_agent.adaptation.controller import Adapter
from famle_agent.adaptation.settings import Adaptation
from famle_agent.adaptation.state import OnlineState
from famle_agent.models.dynamics import Dynamics
from famle_agent.planning import Planner

__all__ = ["LoggedAgent", "LoggedPolicy", "LoggedSettings"]


class LoggedSettings(Protocol):
    """Its settings."""

    @property
    def adaptation(self) -> Adaptation:
        """How it adapts."""

    @property
    def planner(self) -> Planner:
        """How it plans."""

    def to_dict(self) -> dict[str, Any]:
        """Returns all of them by name."""


class LoggedPolicy(Protocol):
    """What it has learnt, and how it acts on it."""

    @property
    def config(self) -> LoggedSettings:
        """All settings."""

    @property
    def model(self) -> Dynamics:
        """The meta-learned model."""

    @property
    def adapter(self) -> Adapter:
        """What adapts the model."""

    def initial(self, robots: int) -> OnlineState:
        """Returns the state of B robots that have seen nothing."""


class LoggedAgent(Protocol):
    """An agent that is written about.

    Attributes:
        mode: The settings that it began with.
        seed: Of its chance.
    """

    mode: str
    seed: int | None

    @property
    def policy(self) -> LoggedPolicy:
        """Its settings, and what it has learnt."""

    @property
    def situations(self) -> Sequence[str]:
        """What the training situations are called."""

    @property
    def overruns(self) -> int:
        """How often a step took too long."""

    @property
    def cut_short(self) -> int:
        """How often the planner left out iterations."""

    @property
    def left_out(self) -> int:
        """How many gradient steps were left out."""

    def posterior(self, state: OnlineState | None = None) -> dict[str, float]:
        """Says how likely each situation is by name; without a state, as far as the agent knows now."""

    def marginals(self, state: OnlineState) -> dict[str, float]:
        """Says how likely each training situation is, alone or as a part."""

    def diagnose(self, state: OnlineState) -> object:
        """Says in words what is most likely wrong."""
