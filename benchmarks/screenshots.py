"""The pictures of TensorBoard in the manual: an ant that breaks in mid-run, seen in a browser without a window.

python -m benchmarks.screenshots
"""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from tensorboard.program import TensorBoard

from benchmarks.runner import launch
from famle_agent.app.demo import run_demo
from famle_agent.utils.atomic_write import whole_file

_PAGES = {
    "scalars": (
        "scalars&tagFilter=posterior/(intact|joint 2 dead)|error_(after|unadapted)&_smoothingWeight=0",
        (1060, 740),
        1.0,
    ),
    "images": ("images&tagFilter=posterior&regexInput=^with_", (860, 410), 1.5),
    "text": ("text&tagFilter=diagnosis&regexInput=^with_", (1060, 600), 1.0),
}
"""Of each picture: what TensorBoard shows, pixels of the page across and down, and pixels of the picture to each."""
_OPTIONS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--hide-scrollbars"]
_PATIENCE = "--virtual-time-budget=20000"  # milliseconds that a page has to draw itself


@dataclass(frozen=True)
class Args:
    """Arguments of the command."""

    out: Path = Path("docs/pictures")
    """Where the pictures go."""
    chromium: str = "chromium"
    """The browser's program."""


def main(args: Args) -> None:
    """Runs the demo of the ant in a folder that is thrown away, as the film does, and keeps pictures of its log.

    Raises:
        FileNotFoundError: There is no such browser.
    """
    if shutil.which(args.chromium) is None:
        raise FileNotFoundError(f"There is no program {args.chromium!r}; install Chromium, or name it by --chromium.")
    with tempfile.TemporaryDirectory() as name:
        run_demo("ant", out=Path(name), seed=0, env={"max_episode_steps": 480}, breaks_at=(0, 150))
        photograph(Path(name, "tensorboard"), args.out, args.chromium)


def photograph(log: Path, out: Path, chromium: str) -> None:
    """Shows the runs in a folder in TensorBoard, and writes pictures of its pages.

    Raises:
        ChildProcessError: The browser fails; the message is its own.
    """
    out.mkdir(parents=True, exist_ok=True)
    board = TensorBoard()
    board.configure(argv=["tensorboard", "--logdir", str(log), "--port", "0", "--load_fast", "false"])
    url = board.launch()
    for title, (page, size, scale) in _PAGES.items():
        with tempfile.TemporaryDirectory() as profile, whole_file(out / f"tensorboard-{title}.png") as new:
            shot = Path(profile, "page.png")
            window = [f"--window-size={size[0]},{size[1]}", f"--force-device-scale-factor={scale}"]
            files = [f"--user-data-dir={profile}", f"--screenshot={shot}"]
            command = [chromium, *_OPTIONS, _PATIENCE, *window, *files, f"{url}?darkMode=false#{page}"]
            done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=300)
            if done.returncode or not shot.exists():
                why = f"status {done.returncode}: {done.stderr}"
                raise ChildProcessError(f"{chromium} made no picture of {title}, {why}")
            Image.open(shot).convert("RGB").quantize(64).save(new, "PNG", optimize=True)


if __name__ == "__main__":
    launch(main, Args)
