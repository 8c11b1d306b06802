"""The experiments of the report and what the paper says of each. A new robot is one entry of :data:`EXPERIMENTS`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

__all__ = ["EXPERIMENTS", "Experiment", "Kind", "Published", "experiment_in"]

Kind = Literal["curves", "episode", "gaits", "distance"]
"""Learning curves, one episode's return, gaits to a goal, or the distance walked."""


@dataclass(frozen=True)
class Published:
    """A row of the paper's tables, or what its text says of a method.

    Attributes:
        method: What the paper calls it.
        steps: Gaits to the goal, mean and deviation over the runs that reached it.
        seconds: The same in seconds of the paper's robot.
        success: Fraction of the runs that reached the goal.
        distance: The largest distance, m.
        time: Seconds of interaction until then.
        solved_at: Robot steps after which the task counts as solved.
        famle_faster_by: How much longer than FAMLE it needs, as a fraction of FAMLE's time.
        remark: Anything else.
    """

    method: str
    steps: tuple[float, float] | None = None
    seconds: tuple[float, float] | None = None
    success: float | None = None
    distance: float | None = None
    time: float | None = None
    solved_at: int | None = None
    famle_faster_by: float | None = None
    remark: str = ""

    def __str__(self) -> str:
        parts = [
            "" if self.steps is None else f"{self.steps[0]} +- {self.steps[1]} gaits",
            "" if self.seconds is None else f"{self.seconds[0]} +- {self.seconds[1]} s",
            "" if self.success is None else f"{100 * self.success:.0f} %",
            "" if self.distance is None else f"{self.distance} m in {self.time:.0f} s",
            "" if self.solved_at is None else f"solved at about {self.solved_at:,} steps",
            "" if self.famle_faster_by is None else f"FAMLE about {100 * self.famle_faster_by:.0f} % faster",
            self.remark,
        ]
        return ", ".join(part for part in parts if part)


@dataclass(frozen=True)
class Experiment:
    """One folder of stored results.

    Attributes:
        folder: Its name; the robot's comes first, before a hyphen.
        title: What is shown.
        kind: What is measured.
        command: What makes the results.
        shared: What the replicates share.
        threshold: The return above which a task that has one is solved.
        budget: Robot steps of the model-based methods, or actions of an episode; a run that does not reach its goal
            counts as one action more.
        paper: What the paper reports.
        paper_replicates: How many it has.
        goal: x and y of where robots are to get to, m; None where they have no goal.
        picture: The picture's name; experiments on gaits with the same name are drawn side by side in it.
    """

    folder: str
    title: str
    kind: Kind
    command: str
    shared: str
    budget: int
    threshold: float = math.inf
    paper: tuple[Published, ...] = ()
    paper_replicates: int = 0
    goal: tuple[float, float] | None = None
    picture: str = ""

    def __post_init__(self) -> None:
        if self.picture and self.kind != "gaits":
            raise ValueError(f"{self.folder}: only experiments on gaits are drawn side by side in one picture.")

    @property
    def robot(self) -> str:
        """The robot's name."""
        return self.folder.partition("-")[0]

    @property
    def picture_name(self) -> str:
        """The name of its picture, without an ending."""
        return self.picture or self.folder


_ONE_MODEL = "Replicates share the meta-trained models; each has its own seed of the robot and the planner"
_SHIPPED = f"{_ONE_MODEL}."
_ANT = f"{_ONE_MODEL}, and its own damage."
_ANT_AND_INFORMED = (
    f"{_ANT} One that is told the damage has the shipped model, which has learnt one round on with the test robot as "
    "one situation more, 15,000 simulated steps of it; FAMLE does better on most damages, so that it is no upper line."
)
_LEGS = f"{_ONE_MODEL}; legs take turns."
_ARM = (
    "Replicates of FAMLE and of the oracle have their own data and their own meta-training. The other model-based "
    "agents share their simulated data and take turns with ten networks, on held actions with five, AMPC with thirty; "
    "a PPO that is trained in simulation first is one policy for all. "
)
_NO_SUCCESS = Published("AMPC", success=0.0)
_ARM_PAPER = (
    Published("FAMLE", solved_at=500),
    Published("AMPC-MAML", famle_faster_by=1.0),
    Published("PPO", remark="below the model-based methods within the limit"),
)
_ANT_PAPER = (
    Published("FAMLE", solved_at=25_000),
    Published("AMPC-MAML", famle_faster_by=5.0),
    Published("PPO", remark="the worst"),
)


def _quadruped(
    situation: str, title: str, shared: str, paper: tuple[Published, ...] = (), picture: str = ""
) -> Experiment:
    return Experiment(
        folder=f"quadruped-{situation}",
        title=f"Quadruped, {title}",
        kind="gaits",
        command=f"python -m benchmarks.quadruped --experiments {situation}",
        shared=shared,
        budget=80,
        paper=paper,
        paper_replicates=10 if paper else 0,
        goal=(2.5, 0.0),
        picture=picture,
    )


def _minitaur(where: str, title: str, paper: tuple[Published, ...] = ()) -> Experiment:
    return Experiment(
        folder=f"minitaur-{where}",
        title=f"Minitaur, {title}",
        kind="distance",
        command=f"python -m benchmarks.minitaur --experiment {where}",
        shared=_SHIPPED,
        budget=60,
        paper=paper,
    )


def _ant(damage: str, title: str, shared: str = _ANT) -> Experiment:
    return Experiment(
        folder=f"ant-{damage}",
        title=f"Ant, {title}",
        kind="episode",
        command=f"python -m benchmarks.ant --experiment {damage}",
        shared=shared,
        budget=1000,
        threshold=800.0,
    )


EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(
        folder="reacher-paper",
        title="Arm, the paper's damage (figure 3)",
        kind="curves",
        command="python -m benchmarks.reacher",
        shared=f"{_ARM}All have the same damage.",
        budget=1000,
        threshold=30.0,
        paper=_ARM_PAPER,
        paper_replicates=30,
    ),
    Experiment(
        folder="reacher-random",
        title="Arm, damage drawn at random",
        kind="curves",
        command="python -m benchmarks.reacher --damage random --replicates 20 --steps 300",
        shared=f"{_ARM}Each has its own damage.",
        budget=300,
        threshold=30.0,
    ),
    Experiment(
        folder="ant-curves",
        title="Ant, unseen damage over many episodes (figure 4; the authors' planned data with 64 sequences of 10,000)",
        kind="curves",
        command="python -m benchmarks.ant --experiment curves --replicates 10",
        shared=_ANT_AND_INFORMED,
        budget=25_000,
        threshold=800.0,
        paper=_ANT_PAPER,
        paper_replicates=30,
    ),
    _ant("unseen", "unseen damage, the first episode", _ANT_AND_INFORMED),
    _ant("untrained", "kinds of damage that were not trained, the first episode"),
    _ant("break", "unseen damage in the middle of an episode"),
    _ant("intact", "intact"),
    _ant("members", "size of the ensemble, on the damage that was tuned on"),
    _ant("validation", "kinds of adaptation, on the damage that was tuned on"),
    _quadruped(
        "yaw",
        "yaw sensor off by 30 degrees (table I)",
        _SHIPPED,
        (
            Published("FAMLE", (32.6, 2.3), (63.4, 4.5), 1.0),
            Published("AMPC-MAML", (61.8, 7.2), (120.1, 13.9), 0.4, famle_faster_by=0.66),
            _NO_SUCCESS,
        ),
        "quadruped",
    ),
    _quadruped(
        "leg",
        "one leg blocked (table I)",
        _LEGS,
        (
            Published("FAMLE", (43.1, 6.4), (83.8, 12.4), 1.0),
            Published("AMPC-MAML", (78.3, 7.2), (152.2, 14.0), 0.4, famle_faster_by=0.66),
            _NO_SUCCESS,
        ),
        "quadruped",
    ),
    _quadruped(
        "both",
        "one leg blocked and yaw sensor off by 30 degrees (table I)",
        _LEGS,
        (
            Published("FAMLE", (41.6, 7.7), (80.9, 15.0), 1.0),
            Published("AMPC-MAML", (79.5, 6.1), (154.6, 11.9), 0.4, famle_faster_by=0.66),
            _NO_SUCCESS,
        ),
        "quadruped",
    ),
    _quadruped("later", "the yaw error strikes after five gaits, which count too", _SHIPPED),
    _quadruped("gap-home", "intact, in its simulator", _SHIPPED, picture="quadruped-gap"),
    _quadruped("gap-held-out", "intact, on held-out dynamics", _SHIPPED, picture="quadruped-gap"),
    _minitaur(
        "held-out",
        "on held-out dynamics (table II)",
        (
            Published("FAMLE", distance=4.8, time=60.0),
            Published("AMPC-MAML", distance=1.6, time=90.0, famle_faster_by=0.5),
            Published("AMPC", distance=0.3, time=130.0),
        ),
    ),
    _minitaur("home", "in its simulator"),
)
"""What the report has a section for, in this order."""


def experiment_in(folder: str) -> Experiment:
    """The experiment whose results are in a folder.

    Raises:
        ValueError: There is none.
    """
    for experiment in EXPERIMENTS:
        if experiment.folder == folder:
            return experiment
    raise ValueError(f"No experiment has its results in {folder!r}; add one to benchmarks/reporting/registry.py.")
