"""D_M of Algorithm 2, the last M transitions (lines 5 and 6), and which of them a gradient step sees (line 3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from famle_agent.models.dynamics import Batch, Dynamics

__all__ = ["Draw", "Memory", "Sample", "minibatches", "whole_memory"]


@dataclass(frozen=True)
class Memory:
    """D_M, the last M transitions of B robots, oldest first. Immutable: :meth:`add` returns a new one.

    Attributes:
        obs: (B, M, obs_dim).
        action: In [-1, 1], (B, M, action_dim).
        next_obs: (B, M, obs_dim).
        log_p: Log-likelihood under each candidate of the newest W transitions, by which candidates are judged,
            (B, W, C), W <= M. It does not change as long as theta_meta does not, so that it is computed once for each
            transition.
        own_log_p: Log-likelihood of the same under what the robot believed when they happened, (B, W).
        weight: 1 for a transition, 0 for a place that is empty yet, (B, M).
    """

    obs: Tensor
    action: Tensor
    next_obs: Tensor
    log_p: Tensor
    own_log_p: Tensor
    weight: Tensor

    @classmethod
    def empty(
        cls,
        robots: int,
        size: int,
        obs_dim: int,
        action_dim: int,
        candidates: int,
        device: torch.device,
        window: int | None = None,
    ) -> Memory:
        """A memory of ``size`` M for B robots that have seen nothing; W is ``window``, None for M."""
        window = size if window is None else min(window, size)
        like = torch.zeros((), device=device, dtype=torch.float32)
        obs, action = (like.new_zeros(robots, size, dim) for dim in (obs_dim, action_dim))
        log_p = like.new_zeros(robots, window, candidates)
        return cls(obs, action, obs, log_p, log_p.new_zeros(robots, window), obs.new_zeros(robots, size))

    @classmethod
    def full(cls, obs: Tensor, action: Tensor, next_obs: Tensor, log_p: Tensor) -> Memory:
        """A memory of M transitions of each robot, of which nobody knows what the robot believed then."""
        weight = obs.new_ones(obs.shape[:2])
        return cls(obs, action, next_obs, log_p, torch.zeros_like(weight), weight)

    @property
    def seen(self) -> int:
        """Transitions of the robot that has most of them."""
        return int(self.weight.sum(dim=1).max())

    @property
    def judging(self) -> Tensor:
        """The weight of the newest W transitions, (B, W)."""
        return self.weight[:, self.weight.shape[1] - self.own_log_p.shape[1] :]

    def range(self) -> tuple[Tensor, Tensor]:
        """Least and largest value of each observed number, (B, obs_dim); infinite for a robot that has seen nothing."""
        empty = self.weight[..., None] == 0.0
        low = torch.minimum(self.obs, self.next_obs).masked_fill(empty, math.inf).amin(dim=1)
        high = torch.maximum(self.obs, self.next_obs).masked_fill(empty, -math.inf).amax(dim=1)
        nothing = low > high
        return low.masked_fill(nothing, -math.inf), high.masked_fill(nothing, math.inf)

    def split(self, newest: int) -> tuple[Memory, Memory]:
        """The same transitions without the newest ones, and with these alone; the others weigh nothing."""
        is_new = torch.arange(self.weight.shape[1], device=self.weight.device) >= self.weight.shape[1] - newest
        return replace(self, weight=self.weight * ~is_new), replace(self, weight=self.weight * is_new)

    def resized(self, size: int, window: int) -> Memory:
        """The newest ``size`` places, with empty ones in front where there are fewer, and ``window`` that judge."""

        def fit(values: Tensor, size: int) -> Tensor:
            empty = values.new_zeros(len(values), size, *values.shape[2:])
            return torch.cat([empty, values], dim=1)[:, -size:]

        window = min(window, size)
        sizes = {name: window if name in ("log_p", "own_log_p") else size for name in vars(self)}
        return Memory(**{name: fit(values, sizes[name]) for name, values in vars(self).items()})

    def each(self, change: Callable[[Tensor], Tensor]) -> Memory:
        """The same with all tensors changed alike."""
        return Memory(**{name: change(values) for name, values in vars(self).items()})

    def where(self, kept: Tensor, other: Memory) -> Memory:
        """This memory for the robots in ``kept`` (B,), and the other one for the rest."""

        def choose(mine: Tensor, theirs: Tensor) -> Tensor:
            return torch.where(kept.view(-1, *[1] * (mine.ndim - 1)), mine, theirs)

        return Memory(**{name: choose(values, getattr(other, name)) for name, values in vars(self).items()})

    def begun_anew(self, rows: Tensor, explained: Tensor) -> Memory:
        """The memory of robots that take their newest transitions for those of another situation.

        They keep those of :meth:`since`.

        Args:
            rows: Which robots do, (B,).
            explained: Log-likelihood of the newest W transitions under what they believe from now on, and as if they
                had believed it in these transitions, (B, W).
        """
        weight = self.weight * self._is_newest(self.since(explained))
        weight = torch.where(rows[:, None], weight, self.weight)
        own_log_p = torch.where(rows[:, None], explained, self.own_log_p)
        return replace(self, own_log_p=own_log_p, weight=weight)

    def since(self, explained: Tensor) -> Tensor:
        """Counts the transitions since which something explains most more than was believed, (B,).

        They are t >= argmax_j g[j] of :meth:`gain`, of several the last: places that hold nothing add nothing to g.

        Args:
            explained: Its log-likelihood of the newest W transitions, (B, W).
        """
        return self.gain(explained).flip(1).argmax(dim=1) + 1

    def without_newest(self, n: Tensor) -> Memory:
        """The same transitions but for the newest n (B,), which weigh nothing."""
        return replace(self, weight=self.weight * ~self._is_newest(n))

    def after(self, older: Memory, n: Tensor) -> Memory:
        """The newest n (B,) transitions of each robot after those of an older memory, whose oldest give way."""

        def joined(new: Tensor, old: Tensor) -> Tensor:
            size = new.shape[1]
            index = torch.arange(size, device=n.device) + n[:, None]
            robot = torch.arange(len(n), device=n.device)[:, None]
            is_old = (index < size).view(*index.shape, *[1] * (new.ndim - 2))
            return torch.where(is_old, old[robot, index.clamp(max=size - 1)], new)

        return Memory(**{name: joined(values, getattr(older, name)) for name, values in vars(self).items()})

    def _is_newest(self, n: Tensor) -> Tensor:
        """Says which places hold the newest n (B,) transitions, (B, M)."""
        return torch.arange(self.weight.shape[1], 0, -1, device=n.device) <= n[:, None]

    def better_explained(self, candidate: Tensor) -> Tensor:
        """Says where theta_meta with a candidate (B,) explains the newest W transitions better than the beliefs, (B,).

        Both are judged by transitions that no gradient step had seen when they were made.
        """
        return self.gain(self.explained_by(candidate))[:, 0] > 0.0

    def gain(self, explained: Tensor) -> Tensor:
        """Computes by how much better something explains the transitions from each of the newest W on, (B, ..., W).

        The cumulative sum ``g[j] = sum_(t >= j) (l[t, c] - l_own[t])``, where l_own is :attr:`own_log_p`: the evidence
        that the robot has been in situation c since transition j.

        Args:
            explained: l, its log-likelihood of the newest W transitions, (B, W), or (B, L, W) of several things.
        """
        own, judging = self.own_log_p, self.judging
        if explained.ndim == 3:
            own, judging = own[:, None], judging[:, None]
        return ((explained - own) * judging).flip(-1).cumsum(dim=-1).flip(-1)

    def explained_by(self, candidate: Tensor) -> Tensor:
        """The log-likelihood of the newest W transitions under a candidate for each robot (B,), (B, W)."""
        index = candidate[:, None, None].expand(-1, self.log_p.shape[1], 1)
        return self.log_p.gather(2, index)[..., 0]

    def add(
        self, obs: Tensor, action: Tensor, next_obs: Tensor, log_p: Tensor, own_log_p: Tensor, valid: Tensor
    ) -> Memory:
        """Inserts one transition per robot where ``valid`` (B,), and drops that robot's oldest."""
        everywhere = bool(valid.all())  # as nearly always; a second copy of a large memory is worth avoiding

        def push(old: Tensor, new: Tensor) -> Tensor:
            moved = torch.cat([old[:, 1:], new[:, None]], dim=1)
            return moved if everywhere else torch.where(valid.view(-1, *[1] * (old.ndim - 1)), moved, old)

        return Memory(
            push(self.obs, obs),
            push(self.action, action),
            push(self.next_obs, next_obs),
            push(self.log_p, log_p),
            push(self.own_log_p, own_log_p),
            push(self.weight, torch.ones_like(valid, dtype=obs.dtype)),
        )


Draw = Callable[[], Batch]
"""Gives the encoded transitions of the next gradient step, of B robots or of each member of their ensembles."""

Sample = Callable[[Dynamics, Memory], Draw]
"""Says what gradient steps on a model see of a memory."""


def whole_memory(model: Dynamics, memory: Memory) -> Draw:
    """Shows all transitions in each step, as in the paper."""
    batch = model.encode(memory.obs, memory.action, memory.next_obs, memory.weight)
    return lambda: batch


def minibatches(size: int, generator: torch.Generator) -> Sample:
    """Draws transitions anew for each step, ``size`` for each member of each robot, with repetitions."""

    def sample(model: Dynamics, memory: Memory) -> Draw:
        robots, M = memory.weight.shape
        robot = torch.arange(robots, device=memory.weight.device)[:, None, None]
        running_number = memory.weight.cumsum(dim=1)  # (B, M)

        def draw() -> Batch:
            shape = (robots, model.members, size)
            chance = torch.rand(shape, generator=generator, device=generator.device, dtype=torch.float32)
            chance = chance.to(memory.weight.device)
            nth = (chance * running_number[:, -1:, None]).floor()
            # Of the transitions that count, the nth is where their running number passes n.
            i = torch.searchsorted(running_number, nth.flatten(1), right=True).clamp(max=M - 1).view(shape)
            return model.encode(
                *(values[robot, i] for values in (memory.obs, memory.action, memory.next_obs, memory.weight))
            )

        return draw

    return sample
