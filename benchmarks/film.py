"""The film of the README and the pictures of the manual: an ant breaks in mid-run and runs on.

python -m benchmarks.film
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from PIL import Image, ImageSequence
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from benchmarks.runner import launch
from famle_agent.app.demo import run_demo
from famle_agent.app.plots import style
from famle_agent.utils.atomic_write import whole_file

_SHOWN = 0.2
"""How likely a situation has to be at some time to be drawn."""


@dataclass(frozen=True)
class Args:
    """Arguments of the command."""

    out: Path = Path("docs/pictures")
    """Where the film and the pictures go."""
    steps: int = 480
    """Control steps to run."""
    breaks_at: int = 150
    """The step before which the ant breaks."""
    colours: int = 24
    """Colours that all pictures of the film share."""
    width: int = 512
    """Pixels across the film."""
    seed: int = 0
    """Seed of the robot and the planner."""


def main(args: Args) -> None:
    """Runs the demo of the ant in a folder that is thrown away, and keeps its film, its speed and its belief."""
    args.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder, limit = Path(name), {"max_episode_steps": args.steps}
        run_demo("ant", out=folder, seed=args.seed, env=limit, breaks_at=(0, args.breaks_at))
        shrink(folder / "robot.gif", args.out / "ant.gif", args.width, args.colours)
        (args.out / "ant-speed.png").write_bytes((folder / "speed.png").read_bytes())
        events = read_events(folder / "tensorboard" / "with_adaptation")
        draw_posterior(read_posterior(events), args.breaks_at, args.out / "ant-belief.png")
        for tag, file in (("posterior", "ant-posterior.png"), ("prediction/path", "ant-path.png")):
            (args.out / file).write_bytes(events.Images(tag)[-1].encoded_image_string)


def shrink(film: Path, out: Path, width: int, colours: int) -> None:
    """Writes a GIF again, smaller, with one palette for all its pictures and no dithering.

    Args:
        film: The GIF to read.
        out: Where the smaller one goes.
        width: Pixels across.
        colours: Size of the palette.
    """
    with Image.open(film) as opened:
        milliseconds = opened.info["duration"]
        size = (width, opened.height * width // opened.width)
        pictures = [frame.convert("RGB").resize(size) for frame in ImageSequence.Iterator(opened)]
    # The widest range of colours: the floor has most of the pixels, and the robot few.
    palette = pictures[len(pictures) // 2].quantize(colours, Image.Quantize.MAXCOVERAGE)
    small = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    with whole_file(out) as new:
        small[0].save(new, "GIF", save_all=True, append_images=small[1:], duration=milliseconds, loop=0, optimize=True)


def read_events(folder: Path) -> EventAccumulator:
    """Reads a run's TensorBoard files."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0})
    events.Reload()
    return events


def read_posterior(events: EventAccumulator) -> dict[str, npt.NDArray[np.float64]]:
    """Takes P(situation | memory) from a run: steps and probabilities, (n, 2), by situation."""
    tags = [tag for tag in events.Tags()["scalars"] if tag.startswith("posterior/")]
    return {tag.partition("/")[2]: np.array([(one.step, one.value) for one in events.Scalars(tag)]) for tag in tags}


def draw_posterior(posterior: Mapping[str, npt.NDArray[np.float64]], breaks_at: int, path: Path) -> None:
    """Draws how likely each situation is over robot steps, of those that are likely at some time.

    Args:
        posterior: Steps and probabilities, (n, 2), by name of the situation.
        breaks_at: The step before which the robot breaks.
        path: Where the PNG goes.
    """
    figure = Figure(figsize=(7.2, 3.2), layout="constrained")
    axes = figure.add_subplot()
    for name, values in posterior.items():
        if values[:, 1].max() > _SHOWN:
            axes.plot(*values.T, label=name)
    axes.axvline(breaks_at, color="0.4", linestyle="--", linewidth=1, label="the ant breaks")
    style(axes, "robot steps", "P(situation | memory)")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    launch(main, Args)
