"""Pictures of what an agent believes and predicts, drawn within a few milliseconds, since a robot waits for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

__all__ = ["PredictedPath", "draw_paths", "draw_posterior", "liveliest"]

Array = npt.NDArray[Any]

_WIDTH = 760
_ROW = 18  # pixels of a line of text
_NAMES = 280  # pixels of the names beside a picture
_MARGIN = 120  # and of the ranges beside the panels
_ROWS = 12  # situations of a picture
_PANEL = 110  # pixels of the height of a panel
_PANELS = 4


@dataclass(frozen=True)
class PredictedPath:
    """Where a robot went, and where a model said that it would go.

    Attributes:
        first: The step at which it begins.
        real: Observations, (n + 1, obs_dim).
        predicted: What the model predicts from the first of them and from the actions alone, (n + 1, obs_dim).
    """

    first: int
    real: Array
    predicted: Array


def draw_posterior(posterior: Array, names: Sequence[str], first: int, last: int) -> Image.Image:
    """Draws how likely situations were through time, bright where they were; the twelve that ever were most likely.

    Args:
        posterior: P(situation | memory) at each moment, (T, C).
        names: C names.
        first: Step of the first moment.
        last: Step of the last one.
    """
    shown = np.sort(np.argsort(-posterior.max(axis=0), kind="stable")[:_ROWS])
    colours = mpl.colormaps["viridis"](posterior[:, shown].T.clip(0.0, 1.0), bytes=True)[..., :3]  # (rows, T, 3)
    bars = Image.fromarray(colours).resize((_WIDTH - _NAMES, _ROW * len(shown)), Image.Resampling.NEAREST)
    sheet = Image.new("RGB", (_WIDTH, bars.height + _ROW), "white")
    sheet.paste(bars, (_NAMES, 0))
    draw = ImageDraw.Draw(sheet)
    for row, situation in enumerate(shown):
        draw.text((_NAMES - 6, _ROW * row + 3), _shortened(names[situation]), fill="black", anchor="ra")
    _label_steps(draw, first, last, bars.height + 3, _NAMES)
    return sheet


def draw_paths(paths: Sequence[PredictedPath], dims: Sequence[int]) -> Image.Image:
    """Draws where a robot went in black, and what was predicted in red, each observed number in a panel of its own.

    Args:
        paths: In the order of time.
        dims: Which numbers of an observation to draw.
    """
    first, last = paths[0].first, paths[-1].first + len(paths[-1].real) - 1
    sheet = Image.new("RGB", (_WIDTH, _PANEL * len(dims) + _ROW), "white")
    draw = ImageDraw.Draw(sheet)
    for panel, dim in enumerate(dims):
        top = _PANEL * panel
        values = np.concatenate([path.real[:, dim] for path in paths])
        low, high = float(values.min()), float(values.max())
        draw.rectangle((_MARGIN, top + 4, _WIDTH - 1, top + _PANEL - 4), outline="lightgray")
        draw.text((6, top + 8), f"observation[{dim}]", fill="black")
        draw.text((_MARGIN - 6, top + 8), f"{high:.3g}", fill="gray", anchor="ra")
        draw.text((_MARGIN - 6, top + _PANEL - 20), f"{low:.3g}", fill="gray", anchor="ra")
        for path in paths:
            x = _MARGIN + (_WIDTH - 1 - _MARGIN) * (path.first + np.arange(len(path.real)) - first) / max(
                last - first, 1
            )
            for line, colour in ((path.real, "black"), (path.predicted, "red")):
                above = (line[:, dim] - low) / max(high - low, 1e-9)  # of 1 at the top
                y = top + 8 + (_PANEL - 16) * (1.0 - above.clip(0.0, 1.0))
                draw.line(list(zip(x.tolist(), y.tolist(), strict=True)), fill=colour, width=2)
    draw.text((_WIDTH // 2, sheet.height - _ROW + 3), "black: real, red: predicted", fill="black")
    _label_steps(draw, first, last, sheet.height - _ROW + 3, _MARGIN)
    return sheet


def liveliest(paths: Sequence[PredictedPath], step: Array) -> list[int]:
    """Chooses up to four observed numbers to draw: those that change most, measured by how much a step changes them.

    Args:
        paths: Where a robot went.
        step: What a step usually changes, (obs_dim,).
    """
    spread = np.concatenate([path.real for path in paths]).std(axis=0) / step
    return sorted(np.argsort(-spread, kind="stable")[:_PANELS].tolist())


def _shortened(name: str, letters: int = 44) -> str:
    """Leaves out the middle of a long name: two faults at once differ at its ends."""
    half = letters // 2 - 1
    return name if len(name) <= letters else f"{name[:half]}...{name[-half:]}"


def _label_steps(draw: ImageDraw.ImageDraw, first: int, last: int, y: float, left: float) -> None:
    draw.text((left, y), f"step {first}", fill="gray")
    draw.text((_WIDTH - 2, y), str(last), fill="gray", anchor="ra")
