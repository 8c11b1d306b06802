"""What became of one step of robots: what was believed before it, what since, and how long that took."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from famle_agent.adaptation.state import OnlineState

__all__ = ["Experience"]


@dataclass(frozen=True)
class Experience:
    """Records the newest step of B robots.

    Attributes:
        before: What the agent believed when it had taken place.
        after: What it believes since it learnt from it.
        transitions: Which robots went through a transition that can be learnt from, (B,).
        plan_ms: Milliseconds that the plan took; None where somebody else has acted.
        adapt_ms: Those that learning from it took.
    """

    before: OnlineState
    after: OnlineState
    transitions: Tensor
    plan_ms: float | None
    adapt_ms: float

    @property
    def adapted(self) -> bool:
        """Whether the robots have adapted in this step."""
        return self.after.belief.adaptations > self.before.belief.adaptations
