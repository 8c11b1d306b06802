"""Pictures of returns."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

__all__ = ["plot_returns", "style"]


def style(axes: Axes, xlabel: str, ylabel: str, title: str = "") -> None:
    """What all our pictures share."""
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    axes.set_title(title)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def plot_returns(returns: Mapping[str, Sequence[float]], title: str, path: str | os.PathLike[str]) -> None:
    """Draws the return of each episode; episode 0 is the intact robot.

    Args:
        returns: Returns by the name of the agent.
        title: Of the picture.
        path: Where the PNG goes.
    """
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for name, values in returns.items():
        axes.plot(range(len(values)), values, marker="o", label=name)
    axes.axvline(0.5, color="0.4", linestyle="--", linewidth=1)
    axes.annotate("breaks", (0.5, 1.0), xycoords=("data", "axes fraction"), xytext=(4, -12), textcoords="offset points")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    style(axes, "episode", "return", title)
    axes.legend()
    figure.savefig(path, dpi=150)
