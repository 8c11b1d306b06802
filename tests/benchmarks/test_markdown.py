from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from benchmarks.reporting import quote
from benchmarks.reporting.figures import figures
from benchmarks.reporting.markdown import headline, in_short
from benchmarks.reporting.registry import EXPERIMENTS
from benchmarks.reporting.report import Report
from benchmarks.reporting.study import read_study
from tests.stored_results import store_curves, store_gaits

ROOT = Path(__file__).parents[2]


def figures_of(results: Path) -> dict[str, pd.DataFrame]:
    studies = [study for one in EXPERIMENTS if (study := read_study(one, results)) is not None]
    return {study.experiment.name: figures(study) for study in studies}


def table_of(results: Path) -> str:
    return headline(figures_of(results))


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Two experiments, which do not have the same methods."""
    folder = tmp_path / "results"
    store_curves(folder, "famle", [[35.0, 35.0, 35.0, 35.0], [37.0, 35.0, 35.0, 35.0]])
    store_curves(folder, "ppo", [[3.0, 3.0, 3.0, 3.0]])
    store_curves(folder, "famle-select", [[34.0, 34.0, 34.0, 34.0]])
    store_gaits(folder, "famle", [10, 20])
    store_gaits(folder, "ampc", [80, None])
    return folder


def test_table_has_a_row_a_method_and_a_column_an_experiment(results: Path) -> None:
    assert table_of(results).splitlines() == [
        "| method | arm: return of the first 50 steps | arm: solved after robot steps "
        "| quadruped, yaw error: success, gaits |",
        "| --- | --- | --- | --- |",
        "| FAMLE | 36.0 | 50 | 100 %, 15.0 +- 7.1 |",
        "| AMPC |  |  | 50 %, 80.0 |",
        "| PPO | 3.0 | 0 of 1 in 200 |  |",
        "",
        "Replicates: 1 to 2 (reacher-paper), 2 (quadruped-yaw).",
    ]


def test_report_begins_with_the_table(results: Path, tmp_path: Path) -> None:
    Report(results, tmp_path / "report")()
    text = (tmp_path / "report" / "report.md").read_text()
    assert table_of(results) in text.split("## All robots")[1].split("\n## ")[0]


def test_short_table_has_a_row_a_robot(results: Path) -> None:
    assert in_short(figures_of(results)).splitlines() == [
        "| robot | measured | FAMLE | the same without adaptation | oracle | runs |",
        "| --- | --- | --- | --- | --- | --- |",
        "| arm, two faults | return of the first 50 steps | 36.0 |  |  | 2 |",
    ]


def test_texts_show_what_is_stored() -> None:
    stored = figures_of(ROOT / "benchmarks" / "results")
    report = (ROOT / "benchmarks" / "report" / "report.md").read_text()
    for page, table in (("README.md", in_short(stored)), ("docs/results.md", headline(stored))):
        assert table in report, "python -m benchmarks.reporting"
        assert table in (ROOT / page).read_text(), "python -m benchmarks.reporting.quote"


def test_tables_are_quoted_where_they_are_marked(results: Path, tmp_path: Path) -> None:
    Report(results, tmp_path / "benchmarks" / "report")()
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("# Title\n<!-- In short -->old<!-- /In short -->\nthe rest\n")
    (tmp_path / "docs" / "results.md").write_text("<!-- All robots -->\n<!-- /All robots -->\n")
    for _ in range(2):
        quote.main(quote.Args(tmp_path))
    stored = figures_of(results)
    assert (tmp_path / "README.md").read_text() == (
        f"# Title\n<!-- In short -->\n\n{in_short(stored)}\n\n<!-- /In short -->\nthe rest\n"
    )
    assert table_of(results) in (tmp_path / "docs" / "results.md").read_text()


def test_page_without_a_mark_stays_as_it_is(results: Path, tmp_path: Path) -> None:
    Report(results, tmp_path / "benchmarks" / "report")()
    (tmp_path / "README.md").write_text("no marks")
    with pytest.raises(ValueError, match="In short"):
        quote.main(quote.Args(tmp_path))
    assert (tmp_path / "README.md").read_text() == "no marks"
