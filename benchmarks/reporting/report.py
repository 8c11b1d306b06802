"""``python -m benchmarks.reporting``: tables, pictures and TensorBoard from stored results; nothing is run again."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
from rich.console import Console
from rich.markdown import Markdown

from benchmarks.harness import write_whole
from benchmarks.reporting.board import write_board
from benchmarks.reporting.headline import headline
from benchmarks.reporting.markdown import document, section
from benchmarks.reporting.pictures import draw, draw_paths, draw_times
from benchmarks.reporting.registry import EXPERIMENTS, experiment_in
from benchmarks.reporting.sine import COMMAND, TITLE, read_sine
from benchmarks.reporting.study import Study, read_study
from benchmarks.reporting.tables import figures, replicates, to_csv

__all__ = ["Report", "show"]


_WIDTH = 180


@dataclass(frozen=True)
class Report:
    """Report on all stored results: report.md with tables and pictures, and every figure as CSV."""

    results: Path = Path("benchmarks/results")
    """Folder of the stored results."""
    out: Path = Path("benchmarks/report")
    """Folder of the report."""
    tensorboard: Path | None = None
    """Folder for TensorBoard, where methods can be laid over each other; by default there is none."""

    def __call__(self) -> None:
        """Reads, counts, draws, and then writes.

        Raises:
            FileNotFoundError: There are no results.
            ValueError: A stored result is damaged.
        """
        found = {experiment: read_study(experiment, self.results) for experiment in EXPERIMENTS}
        studies = [study for study in found.values() if study is not None]
        if not studies:
            raise FileNotFoundError(
                f"{self.results} holds no results; run a benchmark first, such as: {EXPERIMENTS[0].command}"
            )
        missing = [(one.title, one.folder, one.command) for one, study in found.items() if study is None]
        sine = read_sine(self.results)
        missing += [] if sine else [(TITLE, "sine.json", COMMAND)]
        more, pictures = ([], {}) if sine is None else ([sine[0]], {"sine.png": sine[1]})
        texts = _texts(studies, more, missing, self._unknown())
        for name, content in {**_pictures(studies), **pictures, **texts}.items():
            write_whole(self.out / name, content)
        if self.tensorboard is not None:
            write_board(studies, self.tensorboard)
        Console().print(f"{self.out / 'report.md'}: {len(studies)} of {len(EXPERIMENTS)} experiments.")

    def _unknown(self) -> list[str]:
        """Folders of results that are no entry of the registry."""
        known = {experiment.folder for experiment in EXPERIMENTS}
        return sorted({path.parent.name for path in self.results.glob("*/*-*.json")} - known)


def show(results: Path, folder: str) -> None:
    """Prints the section of one experiment, as a benchmark does at its end.

    Raises:
        FileNotFoundError: There are no results of it.
        ValueError: There is no such experiment, or a stored result is damaged.
    """
    study = read_study(experiment_in(folder), results)
    if study is None:
        raise FileNotFoundError(f"{results / folder} holds no results; run the benchmark first.")
    Console(width=_WIDTH).print(Markdown(section(study, figures(study), pictures=[])))


def _texts(
    studies: Sequence[Study], more: Sequence[str], missing: Sequence[tuple[str, str, str]], unknown: Sequence[str]
) -> dict[str, bytes]:
    """The report, with more sections at its end, and its tables by the names of their files."""
    texts, sections, drawn = dict[str, str](), list[str](), set[str]()
    for study in studies:
        rows, folder, picture = figures(study), study.experiment.folder, study.experiment.picture_name
        texts[f"{folder}.csv"] = to_csv(rows)
        shown = [] if picture in drawn else [f"{picture}.png"]
        sections.append(section(study, rows, [*shown, *([f"{folder}-paths.png"] if _walks(study) else [])]))
        drawn.add(picture)
    texts["replicates.csv"] = to_csv([row for study in studies for row in replicates(study)])
    texts["report.md"] = document(
        [f"## All robots\n\n{headline(studies)}", *sections, *more],
        missing,
        unknown,
        ["time.png"] if _with_returns(studies) else [],
    )
    return {name: text.encode() for name, text in texts.items()}


def _pictures(studies: Sequence[Study]) -> dict[str, bytes]:
    """The pictures by the names of their files."""
    groups: dict[str, list[Study]] = {}
    for study in studies:
        groups.setdefault(study.experiment.picture_name, []).append(study)
    pictures = {f"{name}.png": _png(draw(group)) for name, group in groups.items()}
    pictures |= {f"{study.experiment.folder}-paths.png": _png(draw_paths(study)) for study in studies if _walks(study)}
    return pictures | ({"time.png": _png(draw_times(shown))} if (shown := _with_returns(studies)) else {})


def _walks(study: Study) -> bool:
    """Whether it has ways that can be seen from above."""
    return study.experiment.kind in ("gaits", "distance")


def _with_returns(studies: Sequence[Study]) -> list[Study]:
    """Those whose returns can be drawn against the times of several methods."""
    return [study for study in studies if study.experiment.kind in ("curves", "episode") and len(study.times) > 1]


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    return buffer.getvalue()
