"""What robots carry from one step of Algorithm 2 to the next, and how a file holds it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from famle_agent.adaptation.belief import Belief
from famle_agent.adaptation.library import Library
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.senses import Senses
from famle_agent.utils.archive import part_of

__all__ = ["OnlineState"]


@dataclass(frozen=True)
class OnlineState:
    """What B robots carry from one step to the next, as a recurrent policy carries its hidden state. Immutable.

    Attributes:
        memory: The last M transitions.
        belief: The adapted model.
        plan: Where the next search for actions begins, (B, H, action_dim).
        last: The observation and the action of the last step, (B, obs_dim) and (B, action_dim); None where
            somebody else reports the transitions.
        steps: Steps, of a single robot those on which it had a transition. Of several robots all count, since none may
            change when the others adapt.
        adapted_at: How many of them there were when the robots last adapted at the end of an episode.
        senses: What the robots' sensors have said last; None where nobody has asked. No file holds it.
    """

    memory: Memory
    belief: Belief
    plan: Tensor
    last: tuple[Tensor, Tensor] | None = None
    steps: int = 0
    adapted_at: int = 0
    senses: Senses | None = None

    @property
    def robots(self) -> int:
        """B."""
        return len(self.plan)

    def resized(self, memory_size: int, window: int, horizon: int, library_size: int) -> OnlineState:
        """The same for another M, W, H and size of the library."""
        plan = torch.cat([self.plan, torch.zeros_like(self.plan[:, :1]).repeat(1, horizon, 1)], dim=1)[:, :horizon]
        belief, library = self.belief, self.belief.library
        if library is not None:
            belief = replace(belief, library=library.resized(library_size, memory_size, window))
        return replace(self, memory=self.memory.resized(memory_size, window), belief=belief, plan=plan)

    @property
    def counts(self) -> dict[str, int]:
        """What :meth:`to_tensors` leaves out, for a checkpoint."""
        return {"steps": self.steps, "adaptations": self.belief.adaptations, "adapted_at": self.adapted_at}

    def to_tensors(self) -> dict[str, Tensor]:
        """All but :attr:`last` and the counts, for a checkpoint; files have robots and members in one axis."""
        tensors = {f"theta.{name}": value.flatten(0, 1) for name, value in self.belief.theta.items()}
        tensors |= {f"memory.{name}": value for name, value in vars(self.memory).items()}
        names = ("log_posterior", "bias", "excess", "candidate", "diverged", "recognised")
        belief = {name: getattr(self.belief, name) for name in names}
        if (library := self.belief.library) is not None:
            tensors |= {f"library.{name}": value for name, value in library.to_tensors().items()}
        return tensors | belief | {"h": self.belief.h.flatten(0, 1), "plan": self.plan}

    @classmethod
    def from_tensors(cls, tensors: dict[str, Tensor], steps: int, adaptations: int, adapted_at: int) -> OnlineState:
        """The inverse of :meth:`to_tensors`; the counts are :attr:`counts`."""
        log_posterior, candidate = tensors["log_posterior"], tensors["candidate"]
        diverged = tensors.get("diverged", torch.zeros_like(candidate))  # files of version 0.1 do not count
        recognised = tensors.get("recognised", torch.zeros_like(candidate, dtype=torch.bool))
        excess = tensors.get("excess", torch.ones_like(tensors["memory.obs"][:, 0]))  # nor know of other noise
        robots, members = len(candidate), len(tensors["h"]) // len(candidate)
        bias = tensors.get("bias", excess.new_zeros(robots, members, log_posterior.shape[1], excess.shape[1]))
        theta = {name: value.view(robots, -1, *value.shape[1:]) for name, value in part_of(tensors, "theta.").items()}
        h = tensors["h"].view(robots, -1, tensors["h"].shape[1])
        stored = part_of(tensors, "library.")  # which files of robots that have not changed are without
        library = Library.from_tensors(stored) if stored else None
        belief = Belief(theta, h, log_posterior, bias, excess, candidate, diverged, recognised, adaptations, library)
        return cls(Memory(**part_of(tensors, "memory.")), belief, tensors["plan"], steps=steps, adapted_at=adapted_at)
