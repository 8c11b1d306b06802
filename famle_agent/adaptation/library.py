"""What robots had learnt before they changed, so that damage that comes back is recognised."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from famle_agent.adaptation.memory import Memory
from famle_agent.models.dynamics import Batch, Dynamics, Theta
from famle_agent.utils.archive import part_of

__all__ = ["Library", "either", "enlarged"]


@dataclass(frozen=True)
class Library:
    """The models theta*, h* that explained B robots better than all else, until these changed. Immutable.

    There are L places, as many as the robot needs that has most models; each robot's newest model comes first.

    Attributes:
        theta: (B, L, P, ...).
        h: (B, L, P, embedding_dim).
        candidate: With which each model began, (B, L).
        memory: What each model was learnt from; its tensors have an axis L after that of the robots.
        log_p: Log-likelihood under each model of the newest W transitions that the robots went through, (B, L, W).
        full: Which places hold a model, (B, L).
    """

    theta: Theta
    h: Tensor
    candidate: Tensor
    memory: Memory
    log_p: Tensor
    full: Tensor

    @classmethod
    def of(cls, theta: Theta, h: Tensor, candidate: Tensor, memory: Memory, rows: Tensor) -> Library:
        """Holds one model of each robot in ``rows`` (B,).

        Args:
            theta: (B, P, ...).
            h: (B, P, embedding_dim).
            candidate: With which it began, (B,).
            memory: What it was learnt from.
            rows: Whose model counts.
        """
        return cls(theta, h, candidate, memory, memory.own_log_p, rows).each(lambda values: values[:, None])

    # --- how well its models explain a robot ------------------------------------------------------------------

    def residuals(self, model: Dynamics, transition: Batch) -> Tensor:
        """Computes the errors of each model in one transition of each robot, (B, P, L, obs_dim)."""

        def of_one(theta: Theta, h: Tensor) -> Tensor:
            return model.residuals(transition, h, theta)[:, :, 0]

        errors: Tensor = torch.vmap(of_one, in_dims=1, out_dims=2)(self.theta, self.h)
        return errors

    def judged(self, log_p: Tensor, moved: Tensor) -> Library:
        """Adds the log-likelihood (B, L) of the newest transition of the robots that ``moved`` (B,)."""
        pushed = torch.cat([self.log_p[:, :, 1:], log_p[:, :, None]], dim=2)
        return replace(self, log_p=torch.where(moved[:, None, None], pushed, self.log_p))

    def likeliest(self, memory: Memory, explained: Tensor) -> tuple[Library, Tensor]:
        """Finds the model with most evidence that a robot is again what it was.

        Args:
            memory: What the robots go through.
            explained: Log-likelihood of the newest W transitions under what competes with it, (B, W).

        Returns:
            It and what belongs to it, without the axis L; and max_j g[j] of
            :meth:`~famle_agent.adaptation.memory.Memory.gain`, (B,), or -inf where there is no model or what competes
            with it explains the transitions from j on as well.
        """
        gain, since = memory.gain(self.log_p).max(dim=2)  # (B, L)
        other = memory.gain(explained).gather(1, since)
        evidence, place = gain.masked_fill((other >= gain) | ~self.full, -torch.inf).max(dim=1)
        robot = torch.arange(len(place), device=place.device)
        return self.each(lambda values: values[robot, place]), evidence

    def resumed(self, memory: Memory, since: Tensor, rows: Tensor) -> Library:
        """Lets no model be judged by what is older than the newest ``since`` (B,) transitions, of robots in ``rows``.

        Args:
            memory: What the robots go through, which such transitions have come back to.
            since: How many are newer.
            rows: Which robots, (B,).
        """
        window = self.log_p.shape[2]
        older = torch.arange(window, device=since.device) < window - since[:, None]  # (B, W)
        as_good = (older & rows[:, None])[:, None]
        return replace(self, log_p=torch.where(as_good, memory.own_log_p[:, None], self.log_p))

    # --- which models it holds ----------------------------------------------------------------------------------

    def followed_by(self, other: Library | None, size: int) -> Library | None:
        """These models and then those of another library, the first ``size`` of each robot; None without any."""
        both = self
        if other is not None:
            theirs = other.to_tensors()
            tensors = {name: torch.cat([value, theirs[name]], dim=1) for name, value in self.to_tensors().items()}
            both = Library.from_tensors(tensors)
        places = min(size, int(both.full.sum(dim=1).max()))
        order = both.full.byte().argsort(dim=1, descending=True, stable=True)[:, :places]
        robot = torch.arange(len(order), device=order.device)[:, None]
        return both.each(lambda values: values[robot, order]) if places else None

    def only(self, kept: Tensor) -> Library:
        """The same without the models that are not ``kept``, (B, L) or (B, 1)."""
        return replace(self, full=self.full & kept)

    def repeated(self, places: int) -> Library:
        """A single model of each robot in as many places."""
        return self.each(lambda values: values.expand(len(values), places, *values.shape[2:]))

    def of_robot(self, robot: int) -> Library:
        """The library of one robot alone, as of B = 1."""
        return self.each(lambda values: values[robot : robot + 1])

    # --- files --------------------------------------------------------------------------------------------------

    def resized(self, size: int, memory_size: int, window: int) -> Library | None:
        """The first ``size`` models of each robot, for another M and W; None without any."""
        flat = self.each(lambda values: values.flatten(0, 1))
        past = flat.memory.resized(memory_size, window)
        log_p = replace(flat.memory, own_log_p=flat.log_p).resized(memory_size, window).own_log_p
        fitted = replace(flat, memory=past, log_p=log_p).each(
            lambda values: values.view(*self.full.shape, *values.shape[1:])
        )
        return fitted.followed_by(None, size)

    def to_tensors(self) -> dict[str, Tensor]:
        """All of it by name."""
        theta = {f"theta.{name}": value for name, value in self.theta.items()}
        memory = {f"memory.{name}": value for name, value in vars(self.memory).items()}
        rest = {name: getattr(self, name) for name in ("h", "candidate", "log_p", "full")}
        return {**theta, **memory, **rest}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> Library:
        """The inverse of :meth:`to_tensors`."""
        memory = Memory(**part_of(tensors, "memory."))
        h, candidate, log_p, full = (tensors[name] for name in ("h", "candidate", "log_p", "full"))
        return cls(part_of(tensors, "theta."), h, candidate, memory, log_p, full)

    def each(self, change: Callable[[Tensor], Tensor]) -> Library:
        """The same with all tensors changed alike."""
        return Library.from_tensors({name: change(value) for name, value in self.to_tensors().items()})


def enlarged(library: Library | None, new: Library, surprise: float, size: int) -> Library | None:
    """Stores what robots had learnt when they changed, where it explained them better than all else.

    That takes evidence that tells it from each embedding. It takes the place of a model that evidence does not tell it
    from.

    Args:
        library: What is stored already.
        new: A model of each robot, L = 1, with the memory of what the robot had gone through.
        surprise: By how much more one of two models has to explain to be told from the other.
        size: How many models each robot keeps; its oldest goes.
    """
    past = new.memory.each(lambda values: values[:, 0])
    own = (past.own_log_p * past.judging).sum(dim=1, keepdim=True)  # (B, 1)
    embeddings = (past.log_p * past.judging[..., None]).sum(dim=1).amax(dim=1, keepdim=True)
    new = new.only(own - embeddings > surprise)
    if library is None:
        return new.followed_by(None, size)
    stored = (library.log_p * past.judging[:, None]).sum(dim=2).masked_fill(~library.full, -torch.inf)  # (B, L)
    best, place = stored.max(dim=1, keepdim=True)
    new = new.only(own > best)
    alike = torch.zeros_like(library.full).scatter(1, place, new.full & (own - best < surprise))
    return new.followed_by(library.only(~alike), size)


def either(rows: Tensor, mine: Library | None, theirs: Library | None) -> Library | None:
    """Takes one library for the robots in ``rows`` (B,), and the other one for the rest."""
    if mine is theirs:
        return mine
    chosen = [library.only(kept[:, None]) for library, kept in ((mine, rows), (theirs, ~rows)) if library is not None]
    return chosen[0].followed_by(chosen[1] if len(chosen) > 1 else None, max(one.full.shape[1] for one in chosen))
