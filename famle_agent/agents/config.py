"""The settings of an agent: one dataclass for each of its parts, where an alternative is a type."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Set
from dataclasses import dataclass, field, replace
from typing import Any

from famle_agent.adaptation.perception import Safety
from famle_agent.adaptation.settings import Adaptation
from famle_agent.agents.keywords import AT_LEAST_ONE, CHOICES, HINTS, ONLINE, SEEN_IN_DIMS, keywords_of, parts_of
from famle_agent.agents.simulation import Rounds, Simulation
from famle_agent.agents.world_model import ModelConfig
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.planning import ICEM, Planner
from famle_agent.training.reptile import Reptile
from famle_agent.training.trainer import MetaTrainer

__all__ = ["Config", "Hyperparameters", "Rounds", "Safety", "Simulation"]


@dataclass(frozen=True)
class Config:
    """Everything that can be tuned.

    Users give fields by flat keywords, such as ``adapt_every`` for ``adaptation.every``; which is which is said by
    :mod:`~famle_agent.agents.keywords`.

    Attributes:
        simulation: What is simulated to learn from.
        model: The architecture of the dynamics model.
        training: How it is learnt: joint training, then Algorithm 1 or MAML.
        adaptation: How it is adapted on the robot.
        planner: How it is planned with.
        planning_reward: Name of the environment's function that the planner maximises; empty takes its
            ``planning_reward_fn`` or ``reward_fn``.
        safety: What happens on the robot where an observation is missing or a step is late.

    Raises:
        ValueError: A value is out of range, or two contradict each other.
    """

    simulation: Simulation = field(default_factory=Simulation)
    model: ModelConfig = field(default_factory=ModelConfig)
    training: MetaTrainer = field(default_factory=lambda: MetaTrainer(None, Reptile(), InnerLoop(optimizer="adam")))
    adaptation: Adaptation = field(default_factory=Adaptation)
    planner: Planner = field(default_factory=ICEM)
    planning_reward: str = ""
    safety: Safety = field(default_factory=Safety)

    def __post_init__(self) -> None:
        for name, value in self.to_dict().items():
            least = int(name in AT_LEAST_ONE)
            if isinstance(value, (int, float)) and not value >= least:
                raise ValueError(f"{name} must be at least {least}, got {value!r}.")
            if name in CHOICES and value not in CHOICES[name]:
                raise ValueError(f"{name} must be one of {', '.join(map(str, CHOICES[name]))}, got {value!r}.")
        if self.simulation.rounds and self.simulation.policy:
            raise ValueError(
                "rounds go on from random actions, and know nothing of the policy that policy_steps asks for: give one "
                "of them, and 0 for the other."
            )
        if self.simulation.rounds and self.training.joint is None:
            raise ValueError(
                "With rounds, the agent plans in simulation after each of them, with what joint training has learnt: "
                "give joint_iterations and round_iterations too, or rounds=0."
            )

    @classmethod
    def of(cls, values: Mapping[str, Any], chosen: Set[str] = frozenset()) -> Config:
        """Builds settings from a flat mapping; what it does not name has the default.

        Args:
            values: Values by keyword.
            chosen: The keywords that somebody has chosen for this very agent, so that each has to have an effect.

        Raises:
            TypeError: A keyword is no setting, or a value is of the wrong type.
            ValueError: A value is out of range, or one that was chosen has no effect beside the others.
        """
        return cls(**parts_of(values, chosen))

    def to_dict(self) -> dict[str, Any]:
        """The settings that have an effect as a flat mapping of JSON types, the inverse of :meth:`of`."""
        return {**keywords_of(self), "planning_reward": self.planning_reward}

    def changed(self, **settings: Any) -> Config:
        """Returns the same with some settings changed, by their keywords; errors as of :meth:`of`."""
        return Config.of({**self.to_dict(), **settings}, settings.keys())

    def learnt_otherwise(self, other: Config) -> list[str]:
        """Names the settings by which a model that was meta-learned with these differs from what the others give."""
        ours, theirs = self.to_dict(), other.to_dict()
        learning = (name for name in HINTS if name not in ONLINE | SEEN_IN_DIMS)
        names = [name for name in learning if name in ours or name in theirs]
        return [name for name in names if ours.get(name) != theirs.get(name)]

    # --- the rounds of meta-training --------------------------------------------------------------------

    @property
    def last_round(self) -> int:
        """The number of the last round, counted from 0."""
        return self.simulation.rounds.number if self.simulation.rounds else 0

    def trainer(self, number: int, last: bool) -> MetaTrainer:
        """What learns in a round: joint training, and Algorithm 1 or MAML in the last one."""
        joint, rounds = self.training.joint, self.simulation.rounds
        if joint is not None and rounds is not None and number:
            joint = replace(joint, iterations=rounds.iterations)
        return replace(self.training, joint=joint, meta_learner=self.training.meta_learner if last else None)

    def iterations(self, rounds: int, last: bool = True) -> int:
        """Iterations of the learning to the end of a round, counted from 0, with Algorithm 1 if it is the last."""
        trainers = (self.trainer(number, last and number == rounds) for number in range(rounds + 1))
        return sum(trainer.iterations for trainer in trainers)

    def begins_anew(self, number: int, last: bool) -> bool:
        """Whether a round begins with a new model."""
        rounds = self.simulation.rounds
        return number == 0 or (last and rounds is not None and rounds.restart_last)


class Hyperparameters:
    """Deprecated: makes a :class:`Config` of keywords."""

    def __new__(cls, **settings: Any) -> Config:  # type: ignore[misc]
        """Makes a :class:`Config`."""
        return cls.from_dict(settings)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Config:
        """Makes a :class:`Config`."""
        warnings.warn("Hyperparameters is called Config; build one with Config.of(settings).", DeprecationWarning, 3)
        return Config.of(values)
