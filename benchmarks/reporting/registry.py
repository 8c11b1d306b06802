"""The experiments of the report, and how methods are called and drawn.

A new experiment is an entry of ``experiments.yaml``, a method's name and colour a row of ``methods.csv``.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import yaml

Kind = Literal["curves", "episode", "gaits", "distance"]
_FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Published:
    """What the paper says of a method; see ``experiments.yaml``."""

    method: str
    text: str
    gaits: tuple[float, float] | None = None
    distance: float | None = None


@dataclass(frozen=True)
class Experiment:
    """One table of stored results; see ``experiments.yaml``."""

    name: str
    title: str
    kind: Kind
    command: str
    shared: str
    budget: int
    methods: tuple[str, ...] = ()
    threshold: float = math.inf
    paper: tuple[Published, ...] = ()
    paper_replicates: int = 0
    goal: tuple[float, float] | None = None
    picture: str = ""

    def __post_init__(self) -> None:
        if self.picture and self.kind != "gaits":
            raise ValueError(f"{self.name}: only experiments on gaits are drawn side by side in one picture.")

    @property
    def robot(self) -> str:
        """The robot's name."""
        return self.name.partition("-")[0]

    @property
    def picture_name(self) -> str:
        """The name of its picture, without an ending."""
        return self.picture or self.name


@dataclass(frozen=True)
class Style:
    """How a method is shown.

    Attributes:
        label: Its name.
        colour: Of its line, box or point.
        line: Style of its line.
        paper: The paper's name of what it stands beside.
        headline: Whether the table of all robots has a row of it.
    """

    label: str
    colour: str
    line: str = "-"
    paper: str = ""
    headline: bool = False


def _experiment(entry: Mapping[str, Any]) -> Experiment:
    paper, methods = tuple(Published(**row) for row in entry.get("paper", ())), tuple(entry["methods"])
    return Experiment(**{**entry, "shared": " ".join(entry["shared"]), "paper": paper, "methods": methods})


EXPERIMENTS = tuple(map(_experiment, yaml.safe_load((_FOLDER / "experiments.yaml").read_text())))
"""What the report has a section for, in this order."""

_ROWS = pd.read_csv(_FOLDER / "methods.csv", keep_default_na=False).itertuples(index=False)
STYLES: Mapping[str, Style] = {row[0]: Style(*row[1:]) for row in _ROWS}
"""Methods that are shown under another name than their own, in the order of tables and legends."""

_SPARE_COLOURS = ("#17becf", "#bcbd22", "#8c6d31", "#3182bd", "#e6550d", "#31a354", "#756bb1", "#636363")


def experiment_named(name: str) -> Experiment:
    """Finds an experiment.

    Raises:
        ValueError: There is none.
    """
    for experiment in EXPERIMENTS:
        if experiment.name == name:
            return experiment
    raise ValueError(f"There is no experiment {name!r}; add one to benchmarks/reporting/experiments.yaml.")


def style_of(method: str) -> Style:
    """Finds how a method is shown; an unknown one under its own name, in the same colour every time."""
    spare = _SPARE_COLOURS[zlib.crc32(method.encode()) % len(_SPARE_COLOURS)]
    return STYLES.get(method, Style(method, spare))


def in_order(methods: Iterable[str]) -> list[str]:
    """Sorts methods as in :data:`STYLES`, those that are not in it at the end."""
    rank = {method: i for i, method in enumerate(STYLES)}
    return sorted(methods, key=lambda method: (rank.get(method, len(rank)), method))
