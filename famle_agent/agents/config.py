"""The settings of an agent, and the parts they build."""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Literal

from famle_agent.adaptation.adapters import Adaptation
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.planning import ICEM, MPPI, Planner, RandomShooting
from famle_agent.training.maml import MAML
from famle_agent.training.multitask import JointTraining
from famle_agent.training.reptile import Reptile
from famle_agent.training.trainer import MetaTrainer

__all__ = ["Hyperparameters"]


@dataclass(frozen=True)
class Hyperparameters:
    """Everything that can be tuned.

    Attributes:
        transitions_per_situation: n, random transitions simulated in each training situation.
        action_hold: Steps that a random action is held while data are collected; the paper's is 1.
        episode_length: Steps of an episode of simulated data, apart from the task's time limit; 0 takes that.
        rounds: How often the agent goes back to simulation, plans there in every training situation, and learns on
            from all transitions; 0 learns from random actions alone, as the paper does.
        round_transitions: Transitions simulated in each training situation in each such round.
        restart_last_round: Whether the last round learns a new model from all transitions, instead of going on with the
            one that planned; so do the authors, whose planned transitions come from networks of their own.
        hidden: Width of each hidden layer of the dynamics model.
        embedding_dim: Size of a situation embedding h.
        egocentric: Whether the model sees a robot's pose on a floor from the robot itself, where the environment names
            it (``pose_dims``); the paper's does not.
        raw_angles: Whether the model sees angles as plain numbers, which jump from pi to -pi, instead of their sine and
            cosine; so does the authors' public code.
        gate_actions: Whether h scales the actions inside the model; the paper's network only concatenates it.
        interaction_rank: Rank of the products of h and the inputs in the first layer; 0 is the paper's network.
        members: Networks of the ensemble, each with its own embeddings; 1 is the paper's.
        activation: Of the model's hidden layers, ``"silu"`` or, as the authors' public code, ``"relu"``.
        output_limit: L of a predicted change L tanh(z), in deviations of the data's; 0, the paper's, has no limit, the
            authors' code 10.
        normalise_actions: Whether the model sees actions of zero mean and unit deviation, as the authors' code does.
        initial_weights: Distribution of theta before learning: ``"normal"``, or ``"uniform"`` as PyTorch has it by
            itself, and so the authors' public code.
        degrees_of_freedom: Of the Student-t likelihood that tells situations apart; 0 is a Gaussian (the paper's).
        joint_iterations: Steps of training on all situations at once before Algorithm 1; 0 is the paper's.
        round_iterations: The same in each later round.
        joint_lr: Rate of theta in joint training.
        joint_embedding_lr: Rate of H in joint training.
        joint_batch_size: Transitions per step of joint training and member of the ensemble.
        meta_learner: ``"reptile"``, which is FAMLE's, or for the rivals without embeddings ``"first-order-maml"`` or
            ``"maml"``.
        query_size: Transitions by which MAML judges the inner steps.
        inner_optimizer: Optimiser of the inner loop, ``"sgd"`` (the paper's) or ``"adam"``.
        inner_steps: k of meta-learning.
        inner_lr: alpha, rate of theta in the inner loop.
        embedding_lr: beta, rate of h in the inner loop.
        batch_size: Transitions per inner step of meta-learning.
        meta_iterations: Iterations of Algorithm 1, or of MAML; 0 leaves it at the joint training.
        meta_lr: alpha_meta; of MAML, the rate of the outer Adam.
        embedding_meta_lr: beta_meta.
        meta_batch_size: Situations per iteration of Algorithm 1; the paper's is 1.
        compose: Whether the most likely embedding is looked for among the sums of two training situations too, which
            stand for both faults at once; the paper has none.
        likelihood_power: Exponent of the likelihood of a transition; below 1 where errors are not independent of each
            other, so that one strange moment does not overturn what many have shown. The paper's is 1.
        hazard: Probability per step that the robot breaks (or is repaired), for a posterior that is filtered over all
            transitions; 0 takes the likelihood of the last M, as the paper does.
        adapt_every: K, robot steps between two adaptations; 0 never adapts while an episode lasts.
        adapt_at_reset: Whether to adapt when an episode ends.
        memory_size: M, transitions that adaptation looks back on.
        adapt_optimizer: Optimiser of online adaptation; None takes ``inner_optimizer``.
        adapt_steps: k of online adaptation; None takes ``inner_steps``, 0 only selects an embedding.
        adapt_epochs: Passes through the memory instead of ``adapt_steps``, of several robots that of the one that has
            seen most; 0 counts steps.
        adapt_batch_size: Transitions per step of online adaptation, drawn from the memory; 0 takes all, as the paper
            does.
        keep_adapting: Whether gradient steps go on from where the last ones led, instead of beginning with what was
            meta-learned each time (the paper's). FAMLE begins anew where another embedding than the one it began with
            explains the robot better than its adapted model does, with the transitions that selected it alone. Where
            it is the same embedding, the steps go on, but the embedding alone plans as long as it explains more.
        selection_size: The newest transitions, by which the embedding is selected; 0 takes all M, as the paper does.
        adapt_lr: alpha of online adaptation; None takes ``inner_lr``.
        adapt_embedding_lr: beta of online adaptation; None takes ``embedding_lr``.
        adapt_decay: c; after n transitions, each gradient step takes theta c / n of the way back to theta_meta, so that
            it goes far only where much was seen; 0, the paper's, trusts few transitions as much as many.
        validation_size: The newest transitions of the memory, which gradient steps do not see and which decide whether
            the steps are kept; 0 keeps all, as the paper does.
        spread_members: Whether the members of the ensemble start from situations that are sampled from the posterior,
            instead of all from the most likely one (the paper's).
        forget_at_reset: Whether a new episode empties the memory; damage outlasts an episode, so not by default.
        clamp_predictions: Whether a plan may imagine no observation beyond the range of those in the memory, as soon as
            a robot has adapted.
        planning_reward: Name of the environment's function that the planner maximises; empty takes its
            ``planning_reward_fn`` or ``reward_fn``.
        planner: ``"icem"``, ``"mppi"`` or ``"random_shooting"`` (the paper's).
        horizon: H, steps that the planner looks ahead.
        candidates: Sequences judged per iteration of the planner.
        planner_iterations: Iterations of iCEM and MPPI.
        elites: Sequences that iCEM refits its distribution to.
        init_std: Deviation of the first candidates of iCEM and MPPI.
        noise_beta: Exponent of the noise spectrum of iCEM and MPPI; 0 is white.
        temperature: lambda of MPPI, in deviations of the candidates' returns.

    Raises:
        ValueError: A value is out of range.
    """

    transitions_per_situation: int = 2000
    action_hold: int = 1
    episode_length: int = 0
    rounds: int = 0
    round_transitions: int = 1000
    restart_last_round: bool = False
    hidden: tuple[int, ...] = (200, 200)
    embedding_dim: int = 5
    egocentric: bool = True
    raw_angles: bool = False
    gate_actions: bool = True
    interaction_rank: int = 0
    members: int = 1
    activation: Literal["silu", "relu"] = "silu"
    output_limit: float = 0.0
    normalise_actions: bool = False
    initial_weights: Literal["normal", "uniform"] = "normal"
    degrees_of_freedom: float = 0.0
    joint_iterations: int = 0
    round_iterations: int = 0
    joint_lr: float = 1e-3
    joint_embedding_lr: float = 5e-3
    joint_batch_size: int = 512
    meta_learner: Literal["reptile", "first-order-maml", "maml"] = "reptile"
    query_size: int = 64
    inner_optimizer: Literal["sgd", "adam"] = "adam"
    inner_steps: int = 20
    inner_lr: float = 1e-3
    embedding_lr: float = 1e-2
    batch_size: int = 64
    meta_iterations: int = 400
    meta_lr: float = 1.0
    embedding_meta_lr: float = 1.0
    meta_batch_size: int = 20
    compose: bool = False
    likelihood_power: float = 1.0
    hazard: float = 0.0
    adapt_every: int = 5
    adapt_at_reset: bool = False
    memory_size: int = 50
    adapt_optimizer: Literal["sgd", "adam"] | None = None
    adapt_steps: int | None = None
    adapt_epochs: int = 0
    adapt_batch_size: int = 0
    keep_adapting: bool = False
    selection_size: int = 0
    adapt_lr: float | None = None
    adapt_embedding_lr: float | None = None
    adapt_decay: float = 0.0
    validation_size: int = 0
    spread_members: bool = False
    forget_at_reset: bool = False
    clamp_predictions: bool = False
    planning_reward: str = ""
    planner: Literal["icem", "mppi", "random_shooting"] = "icem"
    horizon: int = 10
    candidates: int = 100
    planner_iterations: int = 3
    elites: int = 10
    init_std: float = 0.5
    noise_beta: float = 2.0
    temperature: float = 0.1

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(int(width) for width in self.hidden))
        for field in dataclasses.fields(self):
            value, least = getattr(self, field.name), int(field.name in _AT_LEAST_ONE)
            if isinstance(value, (int, float)) and not value >= least:
                raise ValueError(f"{field.name} must be at least {least}, got {value!r}.")
        if self.hazard >= 1.0:
            raise ValueError(f"hazard is a probability below 1, got {self.hazard!r}.")
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden must name the width of at least one layer, got {self.hidden}.")
        if self.adapt_epochs and not self.adapt_batch_size:
            raise ValueError("adapt_epochs needs an adapt_batch_size; adapt_steps counts steps on the whole memory.")
        if self.adapt_at_reset and self.forget_at_reset:
            raise ValueError("adapt_at_reset learns from what forget_at_reset throws away; choose one of them.")
        if self.validation_size >= self.memory_size:
            raise ValueError(
                f"validation_size must be below memory_size, {self.memory_size}, or nothing is left to learn from; "
                f"got {self.validation_size}."
            )
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(map(str, choices))}, got {getattr(self, name)!r}.")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Hyperparameters:
        """Builds settings from a mapping.

        Raises:
            TypeError: A key is no setting, or a value is of the wrong type.
        """
        known = typing.get_type_hints(cls)
        for key, value in values.items():
            if key not in known:
                close = difflib.get_close_matches(key, known, n=1)
                hint = f" Did you mean {close[0]!r}?" if close else ""
                raise TypeError(f"There is no setting {key!r}.{hint} Settings: {', '.join(known)}.")
            _check_type(key, value, known[key])
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON types."""
        return dataclasses.asdict(self) | {"hidden": list(self.hidden)}

    def learnt_otherwise(self, other: Hyperparameters) -> list[str]:
        """Names the settings by which a model that was meta-learned with these differs from what the others give."""
        names = [field.name for field in dataclasses.fields(self) if field.name not in _ONLINE]
        return [name for name in names if getattr(self, name) != getattr(other, name)]

    def iterations(self, rounds: int, last: bool = True) -> int:
        """Iterations of the learning to the end of a round, counted from 0, with Algorithm 1 if it is the last."""
        return self.joint_iterations + rounds * self.round_iterations + last * self.meta_iterations

    def joint_training(self, round_: int) -> JointTraining:
        """What comes before Algorithm 1, in each round."""
        iterations = self.round_iterations if round_ else self.joint_iterations
        return JointTraining(iterations, self.joint_lr, self.joint_embedding_lr, self.joint_batch_size)

    def trainer(self, round_: int, meta_learner: Reptile | MAML | None) -> MetaTrainer:
        """Builds what learns in a round; no iterations of the meta-learner leave it at the joint training."""
        return MetaTrainer(
            self.joint_training(round_), meta_learner if self.meta_iterations else None, self.inner_loop()
        )

    def inner_loop(self) -> InnerLoop:
        """U^k of meta-learning."""
        return InnerLoop(self.inner_steps, self.inner_lr, self.embedding_lr, self.inner_optimizer)

    def on_the_robot(self) -> Adaptation:
        """Builds how a model is adapted."""
        return Adaptation(
            inner_loop=self.adaptation,
            compose=self.compose,
            likelihood_power=self.likelihood_power,
            hazard=self.hazard,
            window=self.selection_window,
            spread_members=self.spread_members,
            keep_adapting=self.keep_adapting,
            batch_size=self.adapt_batch_size,
            validation_size=self.validation_size,
            clamp_predictions=self.clamp_predictions,
        )

    def adaptation(self, seen: int) -> InnerLoop:
        """U^k on the robot: the rule of meta-learning but where it was said otherwise.

        Args:
            seen: Transitions in the memory, for ``adapt_epochs``.
        """

        def own(value: Any, inherited: Any) -> Any:
            return inherited if value is None else value

        steps = own(self.adapt_steps, self.inner_steps)
        return InnerLoop(
            self.adapt_epochs * -(-seen // self.adapt_batch_size) if self.adapt_epochs else steps,
            own(self.adapt_lr, self.inner_lr),
            own(self.adapt_embedding_lr, self.embedding_lr),
            own(self.adapt_optimizer, self.inner_optimizer),
            self.adapt_decay,
        )

    @property
    def selection_window(self) -> int:
        """How many transitions select the embedding."""
        return self.selection_size or self.memory_size

    def reptile(self) -> Reptile:
        """Algorithm 1."""
        return Reptile(
            self.meta_iterations, self.meta_lr, self.embedding_meta_lr, self.meta_batch_size, self.batch_size
        )

    def maml(self) -> MAML:
        """The meta-learner of a model without embeddings."""
        first_order = self.meta_learner == "first-order-maml"
        sizes = self.meta_batch_size, self.batch_size, self.query_size
        return MAML(self.meta_iterations, self.meta_lr, *sizes, first_order=first_order)

    def make_planner(self) -> Planner:
        """The model-predictive controller."""
        if self.planner == "random_shooting":
            return RandomShooting(self.horizon, self.candidates)
        shared = {"iterations": self.planner_iterations, "init_std": self.init_std, "noise_beta": self.noise_beta}
        if self.planner == "mppi":
            return MPPI(self.horizon, self.candidates, temperature=self.temperature, **shared)  # type: ignore[arg-type]
        return ICEM(self.horizon, self.candidates, elites=self.elites, **shared)  # type: ignore[arg-type]


_KINDS: tuple[tuple[type, type, str], ...] = (
    (bool, bool, "True or False"),
    (int, Integral, "a whole number"),
    (float, Real, "a number"),
)
"""Types of settings, what is accepted for them (numpy's numbers too), and what to call that."""


def _check_type(key: str, value: Any, hint: Any) -> None:
    """Refuses a value of a type that a setting cannot have."""
    kinds = typing.get_args(hint) or (hint,)
    if value is None and type(None) in kinds:
        return
    if key == "hidden":
        if isinstance(value, str) or not isinstance(value, Iterable):
            raise TypeError(f"{key} must be a list of whole numbers, got {value!r}.")
        return
    for kind, accepted, name in _KINDS:
        if kind in kinds and (not isinstance(value, accepted) or isinstance(value, bool) != (kind is bool)):
            raise TypeError(f"{key} must be {name}, got {value!r}.")


_ONLINE = {
    *("compose", "likelihood_power", "hazard", "adapt_every", "adapt_at_reset", "memory_size", "forget_at_reset"),
    *("adapt_optimizer", "adapt_steps", "adapt_epochs", "adapt_batch_size", "adapt_lr", "adapt_embedding_lr"),
    *("adapt_decay", "keep_adapting", "selection_size"),
    *("validation_size", "spread_members", "clamp_predictions", "planning_reward"),
    *("planner", "horizon", "candidates", "planner_iterations", "elites", "init_std", "noise_beta", "temperature"),
}
"""Settings of the life on a robot; rounds in simulation plan too, but a model may be used with another planner."""
_AT_LEAST_ONE = {
    *("transitions_per_situation", "action_hold", "round_transitions", "embedding_dim", "members", "joint_batch_size"),
    *("inner_steps", "batch_size", "query_size", "meta_batch_size", "memory_size"),
    *("horizon", "candidates", "planner_iterations", "elites"),
}
"""The other numbers may be 0."""
_CHOICES = {
    "activation": ("silu", "relu"),
    "initial_weights": ("normal", "uniform"),
    "meta_learner": ("reptile", "first-order-maml", "maml"),
    "inner_optimizer": ("sgd", "adam"),
    "adapt_optimizer": (None, "sgd", "adam"),
    "planner": ("icem", "mppi", "random_shooting"),
}
