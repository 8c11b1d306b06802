"""The keywords of settings: users give them flat (``FAMLE("ant", horizon=15)``), and so do YAML files and checkpoints.

:data:`_NAMES` says which keyword is which field of which part, :func:`parts_of` builds the parts that keywords
describe, and :func:`keywords_of` is its inverse.

A new setting is a field of a part, with a default and a line in its docstring, and an entry in :data:`_NAMES`. Where it
applies, it has one in :data:`AT_LEAST_ONE`, :data:`CHOICES` and :data:`_NEEDS`. Files without it have the default.
"""

from __future__ import annotations

import dataclasses
import difflib
import reprlib
import typing
import warnings
from collections.abc import Iterable, Mapping, Set
from numbers import Integral, Real
from typing import Any

from famle_agent.adaptation.perception import Safety
from famle_agent.adaptation.settings import Adaptation, Epochs, Filter, GradientSteps, Steps, Window
from famle_agent.agents.simulation import Rounds, Simulation
from famle_agent.agents.world_model import ModelConfig
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.planning import ICEM, MPPI, Planner, RandomShooting
from famle_agent.training.maml import MAML
from famle_agent.training.multitask import JointTraining
from famle_agent.training.policy_search import PolicySearch
from famle_agent.training.reptile import Reptile
from famle_agent.training.trainer import MetaTrainer

__all__ = [
    "AT_LEAST_ONE",
    "CHOICES",
    "HINTS",
    "ONLINE",
    "SAFETY",
    "SEEN_IN_DIMS",
    "described_by",
    "keywords_of",
    "parts_of",
]


def parts_of(values: Mapping[str, Any], chosen: Set[str]) -> dict[str, Any]:
    """Builds the parts of a :class:`~famle_agent.agents.config.Config`; arguments and errors as of its ``of``."""
    for old in chosen & _RENAMED.keys():
        warnings.warn(f"The setting {old} is called {_RENAMED[old]}.", DeprecationWarning, stacklevel=3)
    gone = {name for name, value in values.items() if name in _GONE - chosen or (name == _UNUSED and not value)}
    values = {_RENAMED.get(name, name): value for name, value in values.items() if name not in gone}
    chosen = {_RENAMED.get(name, name) for name in chosen}
    for name, value in values.items():
        if name not in HINTS:
            close = difflib.get_close_matches(name, HINTS, n=1)
            hint = f" Did you mean {close[0]!r}?" if close else ""
            hint = " It is gone; leave it out." if name in _GONE else hint
            raise TypeError(f"There is no setting {name!r}.{hint} Settings: {', '.join(HINTS)}.")
        _check_type(name, value)
    read = _Reader(values)
    parts = {
        "simulation": _simulation(read),
        "model": read.part(ModelConfig),
        "training": _training(read),
        "adaptation": _adaptation(read),
        "planner": _planner(read),
        "safety": read.part(Safety),
        "planning_reward": read["planning_reward"],
    }
    # What is 0, False or None asks for nothing, and needs no effect.
    if idle := [name for name in chosen if name not in read.names and values[name]]:
        needs = "; ".join(f"{name} needs {_NEEDS.get(name, 'other settings')}" for name in idle)
        raise ValueError(f"These settings have no effect beside the others: {needs}. Leave out what has none.")
    return parts


def keywords_of(config: Any) -> dict[str, Any]:
    """Returns the settings of a :class:`~famle_agent.agents.config.Config` that have an effect, as JSON types."""
    found = {**_SWITCHED_OFF, **_flat(config)}
    planners = {kind: name for name, kind in _PLANNERS.items()}
    found["planner"] = planners.get(type(config.planner), type(config.planner).__name__)
    if isinstance(config.training.meta_learner, MAML):
        found["meta_learner"] = "first-order-maml" if config.training.meta_learner.first_order else "maml"
    elif config.training.meta_learner is not None:
        found["meta_learner"] = "reptile"
    return {name: list(value) if isinstance(value, tuple) else value for name, value in found.items()}


def described_by() -> dict[str, list[tuple[type, str]]]:
    """Returns the parts and their fields that each keyword sets, whose docstrings say what it means."""
    found: dict[str, list[tuple[type, str]]] = {keyword: [] for keyword in HINTS}
    for part, names in _NAMES.items():
        for name, keyword in names.items():
            found[keyword].append((part, name))
    return found


class _Reader:
    """Reads settings from a mapping, and notes which have had an effect."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = values
        self.names: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.names.add(name)
        return self._values.get(name, _DEFAULTS[name])

    def part(self, kind: type[Any], **known: Any) -> Any:
        """Builds a part from its keywords; fields that are known already are not read."""
        names = {name: keyword for name, keyword in _NAMES[kind].items() if name not in known}
        return kind(**{name: self[keyword] for name, keyword in names.items()}, **known)

    def idle(self) -> _Reader:
        """Reads the same; what it reads has no effect."""
        return _Reader(self._values)


def _simulation(read: _Reader) -> Simulation:
    rounds = read.part(Rounds) if read["rounds"] else None
    if not read["policy_steps"]:
        random_alone: Simulation = read.part(Simulation, rounds=rounds)
        return random_alone
    idle = read.idle()  # random actions, whose place the policy's take
    n, hold = idle["transitions_per_situation"], idle["action_hold"]
    return Simulation(n, hold, read["episode_length"], rounds, read.part(PolicySearch))


def _training(read: _Reader) -> MetaTrainer:
    joint = None
    if read["joint_iterations"] or (read["rounds"] and read["round_iterations"]):
        joint = read.part(JointTraining)
    if not read["meta_iterations"]:
        return MetaTrainer(joint, None, None)
    meta_learner: Reptile | MAML
    if (kind := read["meta_learner"]) == "reptile":
        meta_learner = read.part(Reptile)
    elif kind in CHOICES["meta_learner"]:
        meta_learner = read.part(MAML, first_order=kind == "first-order-maml")
    else:
        raise ValueError(f"meta_learner must be one of {', '.join(CHOICES['meta_learner'])}, got {kind!r}.")
    return MetaTrainer(joint, meta_learner, read.part(InnerLoop))


def _adaptation(read: _Reader) -> Adaptation:
    if not (read["adapt_every"] or read["adapt_at_reset"]):  # a frozen agent: the rest stays as it was, and is idle
        read = read.idle()
    evidence = read.part(Filter) if read["hazard"] else read.part(Window)
    adaptation: Adaptation = read.part(Adaptation, evidence=evidence, gradient=_gradient(read))
    return adaptation


def _gradient(read: _Reader) -> GradientSteps | None:
    """Gradient steps on the robot: the rule of meta-learning but where it is said otherwise."""

    def inherited(name: str, otherwise: str) -> Any:
        value = read[name]
        return read[otherwise] if value is None else value

    length: Steps | Epochs
    if read["adapt_epochs"]:
        length = read.part(Epochs)
    elif (number := inherited("adapt_steps", "inner_steps")) != 0:
        length = Steps(number)
    else:
        return None
    changes = (
        read["hazard"] and read["warm_start"]
    )  # else nobody looks for a change, and nothing is kept from before it
    steps: GradientSteps = read.part(
        GradientSteps,
        length=length,
        library_size=(read if changes else read.idle())["library_size"],
        lr=inherited("adapt_lr", "inner_lr"),
        embedding_lr=inherited("adapt_embedding_lr", "embedding_lr"),
        optimizer=inherited("adapt_optimizer", "inner_optimizer"),
    )
    return steps


def _planner(read: _Reader) -> Planner:
    if (name := read["planner"]) not in _PLANNERS:
        raise ValueError(f"planner must be one of {', '.join(_PLANNERS)}, got {name!r}.")
    planner: Planner = read.part(_PLANNERS[name])
    return planner


def _same(*names: str) -> dict[str, str]:
    return {name: name for name in names}


_PLANNERS: dict[str, type[Planner]] = {"icem": ICEM, "mppi": MPPI, "random_shooting": RandomShooting}
_LOOK_AHEAD = _same("horizon", "candidates")
_NOISE = {"iterations": "planner_iterations", **_same("init_std", "noise_beta")}
_META = {"iterations": "meta_iterations", **_same("meta_lr", "meta_batch_size", "batch_size")}

_NAMES: dict[type, dict[str, str]] = {
    Simulation: _same("transitions_per_situation", "action_hold", "episode_length"),
    Rounds: {
        "number": "rounds",
        "transitions": "round_transitions",
        "iterations": "round_iterations",
        "restart_last": "restart_last_round",
    },
    PolicySearch: {
        "steps": "policy_steps",
        "updates_per_step": "policy_updates_per_step",
        "batch_size": "policy_batch_size",
        "lr": "policy_lr",
        "hidden": "policy_hidden",
        "interaction_rank": "policy_interaction_rank",
        "discount": "discount",
        "random_steps": "policy_random_steps",
        "untold": "policy_untold",
    },
    ModelConfig: _same(*(field.name for field in dataclasses.fields(ModelConfig))),
    JointTraining: {name: f"joint_{name}" for name in ("iterations", "lr", "embedding_lr", "batch_size")},
    Reptile: {**_META, **_same("embedding_meta_lr")},
    MAML: {**_META, **_same("query_size")},
    InnerLoop: {
        "steps": "inner_steps",
        "lr": "inner_lr",
        "embedding_lr": "embedding_lr",
        "optimizer": "inner_optimizer",
    },
    Adaptation: {
        "every": "adapt_every",
        "at_reset": "adapt_at_reset",
        **_same("memory_size", "forget_at_reset", "compose", "likelihood_power", "clamp_predictions"),
    },
    Window: {"size": "selection_size"},
    Filter: _same("hazard"),
    GradientSteps: {
        **{name: f"adapt_{name}" for name in ("lr", "embedding_lr", "optimizer", "batch_size")},
        **_same("validation_size", "warm_start", "library_size"),
    },
    Steps: {"number": "adapt_steps"},
    Epochs: {"number": "adapt_epochs"},
    RandomShooting: _LOOK_AHEAD,
    ICEM: {**_LOOK_AHEAD, **_NOISE, **_same("elites")},
    MPPI: {**_LOOK_AHEAD, **_NOISE, **_same("temperature")},
    Safety: _same("blind_steps", "safe_action", "step_budget_ms"),
}
"""The keyword of each field of each part."""

_SWITCHED_OFF = {
    **dict.fromkeys(("policy_steps", "rounds", "joint_iterations", "meta_iterations", "adapt_steps"), 0),
    "hazard": 0.0,
}
"""What keywords say of a part that is not there."""

_DEFAULTS: dict[str, Any] = {
    keyword: getattr(part, name, None) for part, names in _NAMES.items() for name, keyword in names.items()
} | {
    **_SWITCHED_OFF,
    **{"meta_iterations": Reptile.iterations, "meta_learner": "reptile", "planner": "icem"},
    **dict.fromkeys(("adapt_steps", "adapt_lr", "adapt_embedding_lr", "adapt_optimizer")),
    **{"adapt_epochs": 0, "inner_optimizer": "adam", "planning_reward": ""},
}

HINTS: dict[str, Any] = {
    keyword: typing.get_type_hints(part)[name] for part, names in _NAMES.items() for name, keyword in names.items()
} | {"meta_learner": str, "planner": str, "planning_reward": str}
for _name in ("adapt_steps", "adapt_lr", "adapt_embedding_lr", "adapt_optimizer"):
    HINTS[_name] |= None  # takes the value of meta-learning

ONLINE = {
    *(
        keyword
        for part in (Adaptation, Window, Filter, GradientSteps, Steps, Epochs, Safety)
        for keyword in _NAMES[part].values()
    ),
    *(keyword for part in _PLANNERS.values() for keyword in _NAMES[part].values()),
    *("planner", "planning_reward"),
}
"""Settings of the life on a robot; rounds in simulation plan too, but a model may be used with another planner."""

SAFETY = frozenset(_NAMES[Safety].values())
"""Settings that matter to a robot alone, and to nothing that is learnt."""

SEEN_IN_DIMS = {"egocentric", "raw_angles"}
"""Settings by which models differ where their dimensions do, which are compared by themselves."""

_RENAMED = {"keep_adapting": "warm_start"}
"""Settings by the names of version 0.1, which its files have."""

_UNUSED = "adapt_decay"
"""A setting of version 0.1 that is 0 in its files."""

_GONE = {"spread_members", "posterior_sampling"}
"""Names of a setting of former versions that files may have; it changed no return beyond the noise."""

AT_LEAST_ONE = {
    *("policy_batch_size", "transitions_per_situation", "action_hold", "round_transitions"),
    *("embedding_dim", "members", "joint_batch_size"),
    *("inner_steps", "batch_size", "query_size", "meta_batch_size", "memory_size"),
    *("horizon", "candidates", "planner_iterations", "elites"),
}
"""The other numbers may be 0."""

CHOICES: dict[str, tuple[Any, ...]] = {
    "activation": ("silu", "relu"),
    "initial_weights": ("normal", "uniform"),
    "meta_learner": ("reptile", "first-order-maml", "maml"),
    "inner_optimizer": ("sgd", "adam"),
    "adapt_optimizer": ("sgd", "adam"),
    "planner": tuple(_PLANNERS),
}

_ADAPTING = "adapt_every or adapt_at_reset"
_NEEDS = {
    **dict.fromkeys(_NAMES[Rounds].values(), "rounds"),
    **dict.fromkeys(_NAMES[PolicySearch].values(), "policy_steps"),
    **dict.fromkeys(("transitions_per_situation", "action_hold"), "policy_steps=0"),
    **dict.fromkeys(_NAMES[JointTraining].values(), "joint_iterations"),
    **dict.fromkeys(_NAMES[InnerLoop].values(), "meta_iterations, or an adaptation that has no rate of its own"),
    **dict.fromkeys((*_META.values(), "meta_learner"), "meta_iterations"),
    "embedding_meta_lr": "meta_iterations and meta_learner='reptile'",
    "query_size": "meta_iterations and a meta_learner that is MAML",
    **dict.fromkeys((*_NAMES[Adaptation].values(), "hazard"), _ADAPTING),
    "selection_size": f"{_ADAPTING}, and no hazard",
    **dict.fromkeys(_NAMES[GradientSteps].values(), f"{_ADAPTING}, and adapt_steps or adapt_epochs"),
    "library_size": f"{_ADAPTING}, gradient steps with warm_start, and a hazard",
    "adapt_epochs": _ADAPTING,
    "adapt_steps": f"{_ADAPTING}, and no adapt_epochs",
    **dict.fromkeys(_NOISE.values(), "planner='icem' or 'mppi'"),
    "elites": "planner='icem'",
    "temperature": "planner='mppi'",
}
"""What a setting needs to have an effect."""

_KINDS: tuple[tuple[type, type, str], ...] = (
    (bool, bool, "True or False"),
    (int, Integral, "a whole number"),
    (float, Real, "a number"),
    (str, str, "text"),
)
"""Types of settings, what is accepted for them (numpy's numbers too), and what to call that."""


def _check_type(name: str, value: Any) -> None:
    """Refuses a value of a type that a setting cannot have."""
    kinds = typing.get_args(HINTS[name]) or (HINTS[name],)
    if value is None and type(None) in kinds:
        return
    if typing.get_origin(HINTS[name]) is tuple:
        if isinstance(value, str) or not isinstance(value, Iterable):
            numbers = "whole numbers" if int in kinds else "numbers"
            raise TypeError(f"{name} must be a list of {numbers}, got {reprlib.repr(value)}.")
        return
    for kind, accepted, what in _KINDS:
        if kind in kinds and (not isinstance(value, accepted) or isinstance(value, bool) != (kind is bool)):
            raise TypeError(f"{name} must be {what}, got {reprlib.repr(value)}.")


def _flat(part: Any) -> dict[str, Any]:
    """The fields of a part, and of the parts that it has, by keyword."""
    values = {keyword: getattr(part, name) for name, keyword in _NAMES.get(type(part), {}).items()}
    for inner in vars(part).values():
        if dataclasses.is_dataclass(inner):
            values |= _flat(inner)
    return values
