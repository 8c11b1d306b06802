from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.reporting.headline import headline, insert
from benchmarks.reporting.registry import EXPERIMENTS
from benchmarks.reporting.report import Report
from benchmarks.reporting.study import Study, read_study
from tests.stored_results import store_curves, store_gaits

ROOT = Path(__file__).parents[2]


def studies(results: Path) -> list[Study]:
    return [study for one in EXPERIMENTS if (study := read_study(one, results)) is not None]


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
    assert headline(studies(results)).splitlines() == [
        "| method | arm: return of the first 50 steps | arm: solved after robot steps "
        "| quadruped, yaw error: success, gaits |",
        "| --- | --- | --- | --- |",
        "| FAMLE | 36.0 (35.5 to 36.5) | 50 | 100 %, 15.0 +- 7.1 |",
        "| AMPC |  |  | 50 %, 80.0 |",
        "| PPO | 3.0 (3.0 to 3.0) | 0 of 1 in 200 |  |",
        "",
        "Replicates: 1 to 2 (reacher-paper), 2 (quadruped-yaw).",
    ]


def test_table_takes_the_place_between_the_marks_alone(results: Path, tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("before\n<!-- report -->\nold\ntable\n<!-- end of report -->\nafter\n")
    for _ in range(2):
        Report(results, tmp_path / "report", readme=readme)()
        text = readme.read_text()
        assert text.startswith("before\n<!-- report -->\n| method |")
        assert text.endswith("(quadruped-yaw).\n<!-- end of report -->\nafter\n")
        assert "old" not in text
    assert headline(studies(results)) in (tmp_path / "report" / "report.md").read_text()


def test_text_without_marks_is_left_as_it_is(tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text("nothing to see")
    with pytest.raises(ValueError, match="no place for the table"):
        insert("| table |", readme)
    assert readme.read_text() == "nothing to see"
    assert list(tmp_path.iterdir()) == [readme]


def test_readme_and_report_show_what_is_stored() -> None:
    table = headline(studies(ROOT / "benchmarks" / "results"))
    assert table in (ROOT / "README.md").read_text(), "run: python -m benchmarks.reporting --readme README.md"
    assert table in (ROOT / "benchmarks" / "report" / "report.md").read_text()
