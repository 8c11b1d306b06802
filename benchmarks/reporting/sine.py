"""The section of the paper's figure 2, sines from a few points, which has no robot and no replicates of its own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

__all__ = ["COMMAND", "TITLE", "read_sine", "sine_section"]

TITLE = "Sines from three, four and five points (figure 2)"
COMMAND = "python -m benchmarks.sine"


def read_sine(results: Path) -> tuple[str, bytes] | None:
    """The section and its picture from what :mod:`benchmarks.sine` has stored; None where it has not.

    Raises:
        ValueError: What is stored is damaged.
    """
    path, picture = results / "sine.json", results / "sine.png"
    if not (path.exists() and picture.exists()):
        return None
    try:
        return sine_section(json.loads(path.read_text())), picture.read_bytes()
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is damaged ({error!r}); make it anew with: {COMMAND}") from error


def sine_section(stored: dict[str, Any]) -> str:
    """The section of a stored result."""
    errors, better = stored["mean_squared_error"], stored["famle_better_than_maml"]
    lines = [["points", *errors, "FAMLE better than MAML"], ["---"] * (len(errors) + 2)]
    for points, share in better.items():
        lines.append([points, *(_spread(of[points]) for of in errors.values()), f"{100 * share:.0f} %"])
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return "\n\n".join(
        [
            f"## {TITLE}",
            "![A sine from three, four and five points](sine.png)",
            f"{stored['title']}: median (quartiles), and on how many sines FAMLE does better. The picture shows the "
            "sine on which the ratio of both errors is the median. *Selection only* is FAMLE without gradient steps. "
            "The paper has pictures of single sines and no figures.",
            table,
            f"`{stored['command']}` at `{stored['commit']}` made the result.",
        ]
    )


def _spread(statistics: dict[str, Any]) -> str:
    low, high = statistics["quartiles"]
    return f"{statistics['median']:.3f} ({low:.3f} to {high:.3f})"
