"""Algorithm 2 while an agent lives on robots: what it carries from one step to the next, whoever runs the loop."""

from __future__ import annotations

import time
import warnings
from dataclasses import replace

import torch
from torch import Tensor

from famle_agent.adaptation.experience import Experience
from famle_agent.adaptation.perception import senses_of
from famle_agent.adaptation.senses import Senses
from famle_agent.adaptation.state import OnlineState
from famle_agent.agents.policy import AdaptivePolicy
from famle_agent.utils.deadline import Deadline
from famle_agent.utils.errors import SensorError

__all__ = ["OnlineAdaptation"]

_FORGETTING = 0.9


class OnlineAdaptation:
    """Adapts an agent to its robots step by step, and keeps what it believes of them.

    A loop of the agent's own calls :meth:`act` and :meth:`learn` in turns. Another loop asks for actions by
    :meth:`predict`, and tells what came of them: by the state that it passes back, or by :meth:`observe` and
    :meth:`locate`. Readings, observations and flags are tensors of B robots, and actions lie in [-1, 1].

    Args:
        policy: What was meta-learned, and how the agent acts on it.

    Attributes:
        state: What the agent believes of its robots; None where it has learnt nothing of them.
        newest: The last step that it learnt from, and what became of it.
        overruns: How often a step took longer than ``step_budget_ms``.
        cut_short: How often the planner left out iterations, so that it would not.
        left_out: How many gradient steps were left out for the same reason.
    """

    def __init__(self, policy: AdaptivePolicy) -> None:
        self.state: OnlineState | None = None
        self.newest: Experience | None = None
        self.overruns = self.cut_short = self.left_out = 0
        self._policy = policy
        self._senses: Senses | None = None  # of the robots that the agent was told of last
        self._told: Experience | None = None  # the newest step, where observe() was told of it
        self._refused: OnlineState | None = None  # a caller's state whose last observation was refused
        self._plan_ms: float | None = None  # what the plan of the step that is under way took
        self._spent_ms = 0.0  # of that step's budget
        self._plan_needs_ms = self._gradient_ms = 0.0  # what a plan takes with all iterations, and a gradient step
        self._warned_of_divergence = self._warned_of_sensors = False

    # --- a loop of the agent's own ----------------------------------------------------------------------

    def act(
        self,
        state: OnlineState,
        readings: Tensor,
        starts: Tensor,
        generator: torch.Generator,
        deadline: Deadline | None = None,
    ) -> tuple[Tensor, OnlineState]:
        """Plans from where robots are (line 4), and counts what was late.

        Args:
            state: What is believed of the robots.
            readings: What their sensors say, (B, obs_dim).
            starts: Which of them were just reset, (B,).
            generator: Source of the planner's chance.
            deadline: By when to act; None begins the time that the settings give a step, if they limit it.

        Returns:
            The action, (B, action_dim), and the new state.

        Raises:
            SensorError: No robot can plan.
        """
        deadline, perception = deadline or self._deadline(), self._policy.perception
        state = perception.begin(state, readings, starts)
        start, before_ms = time.perf_counter(), 0.0 if deadline is None else deadline.spent_ms
        planned = perception.act(state, starts, generator, deadline)
        self._plan_ms = 1e3 * (time.perf_counter() - start)
        if deadline is not None:
            self._spent_ms = deadline.spent_ms
            if planned[1].belief.adaptations == state.belief.adaptations:  # else an episode has ended, and time is its
                self._plan_needs_ms = self._spent_ms - before_ms + deadline.left_out * deadline.turn_ms
            self.overruns += self._spent_ms > deadline.ms
            self.cut_short += deadline.left_out > 0
        return planned

    def learn(self, state: OnlineState, readings: Tensor, moved: Tensor) -> OnlineState:
        """Learns from where the last action led (lines 5 and 6), and adapts every K steps (lines 2 and 3).

        Args:
            state: The state after the last action.
            readings: What the sensors say, (B, obs_dim).
            moved: Whose step counts, (B,); those of the other robots are counted as dropped.

        Returns:
            What is believed since then.
        """
        state = self._learnt_from(state, readings, moved)
        self._warn_of(state)
        return state

    def drop(self, state: OnlineState) -> None:
        """Counts a step of all robots that failed, after the last action."""
        senses = senses_of(state)
        self._senses = senses.dropping(torch.ones_like(senses.known))

    # --- somebody else's loop ---------------------------------------------------------------------------

    def predict(
        self, state: OnlineState | None, readings: Tensor, starts: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, OnlineState]:
        """Plans with a state that the caller holds, after learning from the step that ends here.

        Without a state, plans with what is believed. Else arguments, what is returned and errors as of :meth:`act`.
        """
        deadline, given = self._deadline(), state
        if given is None:
            state = self.state_of(len(readings))
        elif given is self._refused:  # what has come since its last action is no single step
            state = self._policy.perception.begin(replace(given, last=None), readings, torch.ones_like(starts))
        else:
            state = self._caught_up(given, readings, starts)
        try:
            action, state = self.act(state, readings, starts, generator, deadline)
        except SensorError:
            self.refuse(given)
            raise
        if given is None and self.state is not None and self.state.robots == len(readings):
            self.state = replace(self.state, plan=state.plan)  # a loop that drops the state keeps its plan
        self._warn_of(state)
        return action, state

    def refuse(self, state: OnlineState | None) -> None:
        """Notes that an observation was refused: the next one is not one step behind the last one of that state."""
        self._refused = state

    def observe(self, obs: Tensor, action: Tensor, next_obs: Tensor) -> None:
        """Learns from a transition, (B, dim) each."""
        everyone = torch.ones(len(obs), dtype=torch.bool, device=obs.device)
        state = self._policy.perception.begin(self.state_of(len(obs)), obs, ~everyone)
        state = replace(state, last=(senses_of(state).obs, action))
        self._warn_of(self._learnt_from(state, next_obs, everyone))
        self._told = self.newest

    def locate(self, readings: Tensor, dropped: bool) -> None:
        """Notes where robots are, where nobody knows how they got there; counts a step where one was ``dropped``."""
        everyone = torch.ones(len(readings), dtype=torch.bool, device=readings.device)
        state = self._policy.perception.begin(self.state_of(len(readings)), readings, everyone)
        self._senses = senses_of(state).dropping(everyone & dropped)

    def begin_episode(self) -> None:
        """Notes that all robots were reset."""
        if self.state is not None:
            starts = torch.ones(self.state.robots, dtype=torch.bool, device=self.state.plan.device)
            self.state = self._policy.controller.reset(self.state, starts)
            self._warn_of(self.state)

    # --- what is believed -------------------------------------------------------------------------------

    def forget(self) -> None:
        """Returns to what was meta-learned."""
        self.state = self.newest = self._told = self._senses = None

    @torch.inference_mode(mode=False)
    def state_of(self, robots: int) -> OnlineState:
        """Returns what is believed where that is of B robots, else what was meta-learned."""
        senses = self._senses if self._senses is not None and self._senses.robots == robots else None
        if self.state is not None and self.state.robots == robots:
            return replace(self.state, last=None, senses=senses)
        return replace(self._policy.initial(robots), senses=senses)

    def state_for(self, state: OnlineState | None, robot: int) -> OnlineState:
        """Returns a state, or what is believed where that is None.

        Raises:
            IndexError: It is not of that robot.
        """
        state = state or self.state or self.state_of(self._policy.model.robots)
        _check_robot(robot, state.robots)
        return state

    def health(self, state: OnlineState | None, robot: int) -> dict[str, int]:
        """Counts what was missing or late, of the robots that the agent was told of last where ``state`` is None.

        Raises:
            IndexError: There is no such robot.
        """
        senses = self._senses if state is None else state.senses
        if senses is None:
            senses = senses_of(self.state_for(state, robot))
        _check_robot(robot, senses.robots)
        counts = {name: int(count[robot]) for name, count in senses.counts.items()}
        late = {name: getattr(self, name) for name in ("overruns", "cut_short", "left_out")}
        return {**counts, **late}

    # --- steps of the loops -----------------------------------------------------------------------------

    def _deadline(self, reserved_ms: float = 0.0, turn_ms: float = 0.0) -> Deadline | None:
        """Begins the time of a step, less what is reserved for other work, where the settings limit it."""
        budget = self._policy.config.safety.step_budget_ms
        return None if budget is None else Deadline(budget - reserved_ms, self._policy.device, turn_ms)

    def _learnt_from(self, state: OnlineState, readings: Tensor, moved: Tensor) -> OnlineState:
        """Learns from a step that ends here, and notes what became of it; arguments as of :meth:`learn`."""
        perception = self._policy.perception
        before, transitions = perception.sense(state, readings, moved)
        before = replace(before, senses=senses_of(before).dropping(~moved))
        self.newest = self._told = None  # frees the memories of the last step before others are made
        start = time.perf_counter()
        after, deadline = self._observed(before, transitions, self._spent_ms)
        if deadline is not None:
            self.overruns += deadline.passed and deadline.ms >= 0.0  # else the plan was late, and is counted
        self.newest = Experience(before, after, transitions, self._plan_ms, 1e3 * (time.perf_counter() - start))
        self._plan_ms, self._spent_ms = None, 0.0
        self.state, self._senses = after, after.senses
        return after

    def _caught_up(self, state: OnlineState, readings: Tensor, starts: Tensor) -> OnlineState:
        """Adds the step that ends here to a state, unless :meth:`observe` was told of it."""
        if state.last is None:
            return state
        perception = self._policy.perception
        sensed, transitions = perception.sense(state, readings, ~starts)
        if self.state is not None and self._told is not None and _same_step(self._told.before, sensed, ~starts):
            return replace(self.state, plan=state.plan, last=None, senses=self._senses)
        return self._observed(sensed, transitions, self._plan_needs_ms)[0]

    def _observed(self, state: OnlineState, transitions: Tensor, plan_ms: float) -> tuple[OnlineState, Deadline | None]:
        """Learns from a step in the time that a plan leaves of the budget, and counts what was left out."""
        deadline = self._deadline(plan_ms, self._gradient_ms)
        after = self._policy.perception.observe(state, transitions, deadline)
        if deadline is not None:
            self.left_out += deadline.left_out
            # Where steps are left out, believe a little less each time that they take so long: one may have been slow.
            self._gradient_ms = deadline.turn_ms * (_FORGETTING if deadline.left_out else 1.0)
        return after, deadline

    def _warn_of(self, state: OnlineState) -> None:
        """Warns of the first sensor that failed, and of the first adaptation that diverged."""
        senses = state.senses
        if not self._warned_of_sensors and senses is not None and not senses.measured.all():
            self._warned_of_sensors = True
            robots = (~senses.measured).nonzero()[:, 0].tolist()
            warnings.warn(
                f"An observation of robot {', '.join(map(str, robots))} cannot be a measurement: "
                f"{senses.reading[robots[0]].tolist()}. It is not learnt from, and plans begin where the model "
                'says that the robot is. info["famle"] and TensorBoard count these from here on.',
                stacklevel=5,
            )
        if not self._warned_of_divergence and state.belief.diverged.any():
            self._warned_of_divergence = True
            warnings.warn(
                f"Adaptation {state.belief.adaptations} diverged: its gradient steps left the finite numbers and were "
                "taken back. Take smaller rates (adapt_lr, adapt_embedding_lr), or meta-learn on data that reach where "
                'the robot is (action_hold, episode_length, rounds). info["famle"]["diverged"] and adapt/diverged '
                "count them from here on.",
                stacklevel=5,
            )


def _same_step(told: OnlineState, sensed: OnlineState, moved: Tensor) -> bool:
    """Whether two states remember the same step, which led to the same place where a robot ``moved`` (B,)."""
    if told.last is None or sensed.last is None:
        return False
    (obs, action), (other_obs, other_action) = told.last, sensed.last
    if not (torch.equal(obs, other_obs) and torch.allclose(action, other_action, atol=1e-5)):
        return False
    return torch.equal(senses_of(told).obs[moved], senses_of(sensed).obs[moved])


def _check_robot(robot: int, robots: int) -> None:
    if not 0 <= robot < robots:
        raise IndexError(f"There are robots 0 to {robots - 1}, not {robot}.")
