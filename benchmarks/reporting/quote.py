"""Quotes the report's tables where people read them first: ``python -m benchmarks.reporting.quote``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks.runner import launch
from famle_agent.utils.marked_text import write_marked

QUOTED: Mapping[str, str] = {"In short": "README.md", "All robots": "docs/results.md"}
"""Sections of the report, and the page that quotes each, where it is marked by its name."""


@dataclass(frozen=True)
class Args:
    """Arguments of the command."""

    root: Path = Path()
    """The repository."""


def main(args: Args) -> None:
    """Writes each quoted section into its page.

    Raises:
        ValueError: The report has no such section, or the page has no place for it.
    """
    report = (args.root / "benchmarks" / "report" / "report.md").read_text()
    for title, page in QUOTED.items():
        found = re.search(rf"^## {title}\n\n(.*?)(?=\n\n## )", report, re.MULTILINE | re.DOTALL)
        if found is None:
            raise ValueError(f"The report has no section {title!r}; write it with: python -m benchmarks.reporting")
        write_marked(args.root / page, title, found[1])


if __name__ == "__main__":
    launch(main, Args)
