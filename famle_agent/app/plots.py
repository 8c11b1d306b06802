"""Pictures of returns and speeds, and films side by side."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image, ImageDraw

from famle_agent.rollout import Frames, running_mean

__all__ = ["plot_paths", "plot_returns", "plot_speed", "side_by_side", "style"]

_TITLE = 24
"""Pixels of the title above a film."""

_CAPTION = 54
"""Pixels of the three lines below a film."""


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
    with _picture(path, "episode", "return", title) as axes:
        for name, values in returns.items():
            axes.plot(range(len(values)), values, marker="o", label=name)
        _mark_break(axes, 0.5)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def plot_speed(
    speed: Mapping[str, npt.NDArray[Any]], break_at: int, rate: float, title: str, path: str | os.PathLike[str]
) -> None:
    """Draws speeds over time, means over half a second.

    Args:
        speed: Speed at each step in m/s by the name of the agent.
        break_at: The first step of the broken robot.
        rate: Steps per second.
        title: Of the picture.
        path: Where the PNG goes.
    """
    with _picture(path, "time (s)", "forward speed (m/s)", title) as axes:
        for name, values in speed.items():
            axes.plot(np.arange(len(values)) / rate, running_mean(values, round(rate / 2)), label=name)
        _mark_break(axes, break_at / rate)
        axes.axhline(0.0, color="0.8", linewidth=1)


def plot_paths(
    paths: Mapping[str, npt.NDArray[Any]],
    title: str,
    path: str | os.PathLike[str],
    goal: tuple[float, float] | None = None,
) -> None:
    """Draws the ways of robots from above, a dot for each action.

    Args:
        paths: x and y in m, (n, 2), by the name of the agent.
        title: Of the picture.
        path: Where the PNG goes.
        goal: Where they should get to.
    """
    with _picture(path, "x (m)", "y (m)", title) as axes:
        for name, way in paths.items():
            axes.plot(way[:, 0], way[:, 1], marker=".", label=name)
        if goal is not None:
            axes.plot(*goal, marker="*", markersize=14, color="0.3", linestyle="none", label="goal")
        axes.set_aspect("equal", adjustable="datalim")


@contextmanager
def _picture(path: str | os.PathLike[str], xlabel: str, ylabel: str, title: str) -> Iterator[Axes]:
    """Gives the axes of a picture, which is stored with a legend when all is drawn."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    yield axes
    style(axes, xlabel, ylabel, title)
    axes.legend()
    figure.savefig(path, dpi=150)


def _mark_break(axes: Axes, at: float) -> None:
    """Marks where the robots break on the axis of time."""
    axes.axvline(at, color="0.4", linestyle="--", linewidth=1)
    axes.annotate("breaks", (at, 1.0), xycoords=("data", "axes fraction"), xytext=(4, -12), textcoords="offset points")


def side_by_side(
    films: Mapping[str, Frames], captions: Mapping[str, Sequence[str]] | None = None, size: int = 320
) -> list[npt.NDArray[np.uint8]]:
    """Puts films next to each other under their titles; the shorter ones stop at their last picture.

    Args:
        films: Pictures (height, width, 3) by title.
        captions: Up to three lines below each picture, by title; None writes none.
        size: Pixels of the side of a picture.
    """
    frames = []
    below = 0 if captions is None else _CAPTION
    for i in range(max(len(film) for film in films.values())):
        sheet = Image.new("RGB", (size * len(films), size + _TITLE + below), "white")
        draw = ImageDraw.Draw(sheet)
        for column, (title, film) in enumerate(films.items()):
            shown, left = min(i, len(film) - 1), size * column
            sheet.paste(Image.fromarray(film[shown]).resize((size, size)), (left, _TITLE))
            draw.text((left + 8, 6), title, fill="black")
            if captions is not None:
                draw.multiline_text((left + 8, _TITLE + size + 4), captions[title][shown], fill="black")
        frames.append(np.asarray(sheet))
    return frames
