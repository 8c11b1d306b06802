"""The agent that a demo shows, and the same one without adaptation."""

from __future__ import annotations

from pathlib import Path

from famle_agent.famle import FAMLE

__all__ = ["with_and_without_adaptation"]


def with_and_without_adaptation(agent: FAMLE, out: Path) -> dict[str, FAMLE]:
    """The agent and a copy that never adapts, by name.

    Args:
        agent: Meta-learns first where it has no model.
        out: Folder for its file; it is made.
    """
    if agent.dynamics is None:
        agent.meta_learn(progress_bar=True, n_jobs=-1)
    out.mkdir(parents=True, exist_ok=True)
    agent.save(out / "agent.zip")
    return {"with adaptation": agent, "without adaptation": FAMLE.load(out / "agent.zip", adapt_every=0)}
