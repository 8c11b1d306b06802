"""The settings of what is simulated to learn from (lines 1 to 6 of Algorithm 1)."""

from __future__ import annotations

from dataclasses import dataclass

from famle_agent.training.policy_search import PolicySearch

__all__ = ["Rounds", "Simulation"]


@dataclass(frozen=True)
class Rounds:
    """Going back to simulation: the agent plans there in every situation, and learns on from all transitions.

    Attributes:
        number: How often.
        transitions: Transitions simulated in each training situation in each round.
        iterations: Of the joint training in each round.
        restart_last: Whether the last round learns a new model from all transitions, instead of going on with the one
            that planned; so do the authors, whose planned transitions come from networks of their own.
    """

    number: int
    transitions: int = 1000
    iterations: int = 0
    restart_last: bool = False


@dataclass(frozen=True)
class Simulation:
    """What is simulated to learn from.

    Attributes:
        transitions_per_situation: n, random transitions in each training situation.
        action_hold: Steps that a random action is held; the paper's is 1.
        episode_length: Steps of a simulated episode, apart from the task's time limit; 0 takes that.
        rounds: What is simulated after that; None, the paper's, learns from random actions alone.
        policy: A policy for all situations that is learnt first; what it went through takes the place of random
            actions. None, the paper's, learns none.
    """

    transitions_per_situation: int = 2000
    action_hold: int = 1
    episode_length: int = 0
    rounds: Rounds | None = None
    policy: PolicySearch | None = None

    @property
    def planned(self) -> int:
        """Transitions of each situation in all rounds of planning together."""
        return self.rounds.number * self.rounds.transitions if self.rounds else 0

    def transitions(self, number: int) -> int:
        """Transitions of each situation in a round, counted from 0."""
        return self.rounds.transitions if self.rounds and number else self.transitions_per_situation
