"""``python -m benchmarks.reporting``: tables and pictures from stored results; nothing is run again."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console
from rich.markdown import Markdown

from benchmarks.reporting.figures import figures
from benchmarks.reporting.markdown import document, headline, in_short, section, sine_section
from benchmarks.reporting.pictures import draw, draw_paths, draw_times
from benchmarks.reporting.registry import EXPERIMENTS, experiment_named
from benchmarks.reporting.study import Study, read_study
from benchmarks.results import load
from famle_agent.utils.atomic_write import whole_file

_WIDTH = 180
_SINE = "Sines from three, four and five points (figure 2)", "sine", "python -m benchmarks.sine"
_NO_EXPERIMENTS = {"sine", "performance", "timing", "identification", "prediction", "robustness"}
"""Tables that the registry does not have."""


@dataclass(frozen=True)
class Report:
    """Report on all stored results: report.md with tables and pictures, and every figure as CSV."""

    results: Path = Path("benchmarks/results")
    """Folder of the stored results."""
    out: Path = Path("benchmarks/report")
    """Folder of the report."""

    def __call__(self) -> None:
        """Reads, counts, draws, and then writes.

        Raises:
            FileNotFoundError: There are no results.
            ValueError: A table of results is damaged.
        """
        studies = [study for one in EXPERIMENTS if (study := read_study(one, self.results)) is not None]
        if not studies:
            example = EXPERIMENTS[0].command
            raise FileNotFoundError(f"{self.results} holds no results; run a benchmark first, such as: {example}")
        tables = {study.experiment.name: figures(study) for study in studies}
        files = {f"{name}.csv": _csv(table) for name, table in tables.items()}
        files |= _pictures(studies)
        files["report.md"] = self._text(studies, tables, "time.png" in files).encode()
        if self._has_sines:
            files["sine.png"] = (self.results / "sine.png").read_bytes()
        self.out.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            with whole_file(self.out / name) as partial:
                partial.write_bytes(content)
        Console().print(f"{self.out / 'report.md'}: {len(studies)} of {len(EXPERIMENTS)} experiments.")

    @property
    def _has_sines(self) -> bool:
        return all((self.results / name).exists() for name in ("sine.csv", "sine.png"))

    def _text(self, studies: list[Study], tables: Mapping[str, pd.DataFrame], times: bool) -> str:
        sections = [f"## In short\n\n{in_short(tables)}", f"## All robots\n\n{headline(tables)}"]
        drawn = set[str]()
        for study in studies:
            name, picture = study.experiment.name, study.experiment.picture_name
            pictures = [f"{picture}.png"] * (picture not in drawn) + [f"{name}-paths.png"] * _has_paths(study)
            sections.append(section(study, tables[name], pictures))
            drawn.add(picture)
        missing = [(one.title, one.name, one.command) for one in EXPERIMENTS if one.name not in tables]
        if self._has_sines:
            sections.append(sine_section(_SINE[0], load(self.results / "sine.csv")))
        else:
            missing.append(_SINE)
        unknown = {path.stem for path in self.results.glob("*.csv")} - {one.name for one in EXPERIMENTS}
        return document(sections, missing, sorted(unknown - _NO_EXPERIMENTS), times)


def show(results: Path, name: str) -> None:
    """Prints the section of one experiment, as a benchmark does at its end.

    Raises:
        FileNotFoundError: There are no results of it.
        ValueError: There is no such experiment, or its table is damaged.
    """
    study = read_study(experiment_named(name), results)
    if study is None:
        raise FileNotFoundError(f"{results / name}.csv does not exist; run the benchmark first.")
    Console(width=_WIDTH).print(Markdown(section(study, figures(study), pictures=[])))


def _csv(table: pd.DataFrame) -> bytes:
    return table.round(4).convert_dtypes().to_csv(lineterminator="\n").encode()


def _pictures(studies: list[Study]) -> dict[str, bytes]:
    """Draws the pictures, by the names of their files."""
    groups: dict[str, list[Study]] = {}
    for study in studies:
        groups.setdefault(study.experiment.picture_name, []).append(study)
    drawn = {f"{name}.png": _png(draw(group)) for name, group in groups.items()}
    drawn |= {f"{study.experiment.name}-paths.png": _png(draw_paths(study)) for study in studies if _has_paths(study)}
    timed = [study for study in studies if study.experiment.kind in ("curves", "episode") and len(study.times) > 1]
    return drawn | ({"time.png": _png(draw_times(timed))} if timed else {})


def _has_paths(study: Study) -> bool:
    return study.experiment.kind in ("gaits", "distance")


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150)
    return buffer.getvalue()
