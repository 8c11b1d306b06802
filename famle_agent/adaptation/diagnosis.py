"""What is most likely wrong with a robot, in words: the posterior of line 2, and how far that can be believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["STRANGE", "Diagnosis"]

STRANGE = 2.5  # times the errors of simulation; robots in another simulator's profile stay below


@dataclass(frozen=True)
class Diagnosis:
    """Names what is most likely wrong with one robot.

    Attributes:
        situation: The most likely training situation, or ``"a + b"`` for two faults at once.
        probability: How likely it is among all that were trained.
        error: Errors of its predictions, in those of simulation: about 1 where the robot is as it was trained. It is
            measured where the posterior is filtered (``hazard``), and is 1 where it is not.
        steps: Transitions that this rests on.
        recognised: Whether the robot is as it was once before it changed, and is planned with what it had learnt then.
    """

    situation: str
    probability: float
    error: float
    steps: int
    recognised: bool = False

    @classmethod
    def of(cls, posterior: Mapping[str, float], error: float, steps: int, recognised: bool = False) -> Diagnosis:
        """Makes the diagnosis that a posterior stands for.

        Args:
            posterior: P(situation | memory) by name.
            error: Errors of the predictions, in those of simulation.
            steps: Transitions that were seen.
            recognised: Whether the robot is as it was once before it changed.
        """
        situation = max(posterior, key=lambda name: posterior[name])
        return cls(situation, posterior[situation], error, steps, recognised)

    @property
    def is_known(self) -> bool:
        """Whether the robot does what some training situation, or the sum of two, predicts."""
        return self.error < STRANGE

    def __str__(self) -> str:
        if not self.steps:
            return "Nothing has been seen of the robot yet."
        before = " The robot has been like this before." if self.recognised else ""
        if not self.is_known:
            return (
                f"Unlike anything that was trained: errors are {self.error:.1f} times those of simulation. "
                f"The nearest is {self.situation} ({self.probability:.0%}).{before}"
            )
        return f"Most likely {self.situation} ({self.probability:.0%}).{before}"
