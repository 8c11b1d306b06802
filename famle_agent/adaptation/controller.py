"""Algorithm 2 of the paper on B robots at once: observe a transition, adapt every K steps, plan the next action.

State is a value: each call takes one and returns another, as a recurrent policy does with its hidden state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import torch
from torch import Tensor

from famle_agent.adaptation.belief import Belief, Evidence
from famle_agent.adaptation.guide import Guide
from famle_agent.adaptation.memory import Memory
from famle_agent.adaptation.state import OnlineState
from famle_agent.models.reward import Objective
from famle_agent.models.simulator import Simulator
from famle_agent.planning import Judge, Planner, shift
from famle_agent.utils.deadline import Deadline

__all__ = ["Adapter", "Controller"]


class Adapter(Protocol):
    """Turns what robots have gone through into the model that they plan with: lines 2 and 3 of Algorithm 2.

    At each step :meth:`judge` and :meth:`infer` take the newest transition, and every K steps :meth:`adapt` takes the
    memory. Before each plan :meth:`model_for` gives the dynamics.
    """

    def initial(self, robots: int) -> Belief:
        """Returns what B robots believe before they have seen anything: theta_meta and a first embedding."""

    def judge(self, belief: Belief, obs: Tensor, action: Tensor, next_obs: Tensor) -> Evidence:
        """Computes how well each candidate, and the adapted model, predict a transition of each robot, (B, dim)."""

    def infer(self, memory: Memory, belief: Belief, evidence: Evidence, moved: Tensor) -> Belief:
        """Updates the posterior by the newest transition of the robots that ``moved`` (B,)."""

    def adapt(self, memory: Memory, belief: Belief, deadline: Deadline | None = None) -> tuple[Memory, Belief]:
        """Selects an embedding (line 2), takes gradient steps (line 3), and returns what of the memory still counts.

        Gradient steps for which a deadline leaves no time are left out.
        """

    def model_for(self, belief: Belief, memory: Memory) -> Simulator:
        """Returns the dynamics that a belief stands for."""

    def likely(self, belief: Belief) -> Tensor:
        """Returns how likely each training situation is, alone or as a part, (B, N)."""

    def shares(self, belief: Belief) -> Tensor:
        """Returns how much of each training situation the most likely candidate is, (B, N)."""

    def posterior(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Returns P(situation | memory) of the first robot by name, given those of the training situations."""

    def marginals(self, belief: Belief, situations: Sequence[str]) -> dict[str, float]:
        """Returns the same of each training situation, be it alone or a part of what is wrong."""


@dataclass(frozen=True)
class Controller:
    """Runs Algorithm 2.

    The paper's lines are here:

        2     the most likely embedding, given D_M and theta_meta     adapter.judge, .infer and .adapt
        3     k gradient steps on theta and h from there              adapter.adapt
        4     an action by MPC with theta* and h*                     act
        5, 6  the transition goes into D_M, the oldest out of it      observe

    Lines 2 and 3 run every K steps.

    Attributes:
        adapter: Says what robots believe.
        planner: MPC.
        objective: What the planner maximises, with actions in [-1, 1].
        adapt_every: K; 0 never adapts while an episode lasts.
        adapt_at_reset: Whether to adapt when an episode ends.
        forget_at_reset: Whether a new episode empties a robot's memory.
        guide: A policy that proposes plans and sees beyond their end; None plans without.
    """

    adapter: Adapter
    planner: Planner
    objective: Objective
    adapt_every: int
    adapt_at_reset: bool = False
    forget_at_reset: bool = False
    guide: Guide | None = None

    def init(self, belief: Belief, memory: Memory) -> OnlineState:
        """Returns the state of B robots that believe what the adapter says, with an empty memory D_M."""
        robots, _, action_dim = memory.action.shape
        plan = memory.action.new_zeros(robots, self.planner.horizon, action_dim)
        return OnlineState(memory, belief, plan)

    def observe(self, state: OnlineState, obs: Tensor, starts: Tensor, deadline: Deadline | None = None) -> OnlineState:
        """Adds the transition that ends here to the memory (lines 5 and 6), and adapts every K (lines 2 and 3).

        Args:
            state: The state after the last action.
            obs: Where the robots are now, (B, obs_dim).
            starts: Which robots were just reset, (B,): what led here is no transition of theirs.
            deadline: By when to have adapted, if there is one.
        """
        if state.last is None:
            return state
        evidence, belief = self.adapter.judge(state.belief, *state.last, obs), state.belief
        memory = state.memory.add(*state.last, obs, evidence.log_p, evidence.own_log_p, valid=~starts)
        if starts.all() and state.robots == 1:
            return replace(state, last=None)
        steps, belief = state.steps + 1, belief.judged(evidence, ~starts)
        if self.adapt_every or self.adapt_at_reset:
            belief = self.adapter.infer(memory, belief, evidence, ~starts)
        if self.adapt_every and steps % self.adapt_every == 0:
            memory, belief = self.adapter.adapt(memory, belief, deadline)
        return replace(state, memory=memory, belief=belief, last=None, steps=steps)

    @torch.no_grad()
    def act(
        self,
        state: OnlineState,
        obs: Tensor,
        starts: Tensor,
        generator: torch.Generator,
        deadline: Deadline | None = None,
    ) -> tuple[Tensor, OnlineState]:
        """Plans an action in [-1, 1], (B, action_dim), with the adapted model (line 4) and by the deadline, if any."""
        state = self.reset(state, starts)
        model = self.adapter.model_for(state.belief, state.memory)
        judge: Judge = partial(model.returns, self.objective, obs)
        proposals = None
        if self.guide is not None:
            likely = self.adapter.likely(state.belief)
            proposals = self.guide.proposals(model, obs, likely, self.planner.horizon, generator)
            objective = self.guide.looking_beyond(self.objective, self.adapter.shares(state.belief), model)
            judge = self.guide.judge(objective, model, obs, proposals[:, :1])
        action, plan = self.planner.plan(judge, state.plan, generator, proposals, deadline)
        return action, replace(state, plan=shift(plan), last=(obs, action))

    def reset(self, state: OnlineState, starts: Tensor) -> OnlineState:
        """Voids the plans of the robots in ``starts`` (B,), and adapts or empties memories where asked to."""
        kept = ~starts
        seen = starts & (state.memory.weight.sum(dim=1) > 0)
        if self.adapt_at_reset and seen.any() and state.steps > state.adapted_at:
            memory, belief = self.adapter.adapt(state.memory, state.belief)
            memory, belief = memory.where(seen, state.memory), belief.where(seen, state.belief)
            state = replace(state, memory=memory, belief=belief, adapted_at=state.steps)
        if self.forget_at_reset:
            memory = replace(state.memory, weight=state.memory.weight * kept[:, None])
            prior = replace(self.adapter.initial(state.robots), diverged=state.belief.diverged)
            state = replace(state, memory=memory, belief=state.belief.where(kept, prior))
        return replace(state, plan=torch.where(kept[:, None, None], state.plan, 0.0))
